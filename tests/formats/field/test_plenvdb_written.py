"""PlenVDB's folder as it is written: read back by us, by torch and OpenVDB, and worked out by its own equations."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import LatticeField, load, memory_limit
from nerfbake.errors import InvalidScene, MemoryLimit
from nerfbake.formats.field import dvgo
from nerfbake.formats.field import plenvdb as form
from nerfbake.formats.volume import openvdb
from nerfbake.io import save_folder
from nerfbake.kernels.lattice.nodes import densities, in_nodes, interpolate_rows
from nerfbake.scene.lattice_field import Activation, MlpColour, RgbColour, ShColour
from nerfbake.stages._lattice import nodes_of, places_of, seen_along, table_of
from tests.support.plenvdb import plenvdb
from tests.support.torch_files import dvgo_file

SHAPE = (17, 12, 14)


def some(**fields: Any) -> LatticeField:
    """Twelve features and an MLP of 2x8, at a tenth of the nodes, and at none of a whole block."""
    random = np.random.default_rng(2)
    held = random.random(SHAPE) < 0.1
    held[:8, :8, :8] = False
    links = np.full(SHAPE, -1, np.int32)
    links[held] = np.arange(np.count_nonzero(held))
    n = int(links.max()) + 1
    shapes = ((8, 12 + 27), (8,), (1, 8, 8), (1, 8), (3, 8), (3,))
    first, first_bias, middle, middle_bias, last, last_bias = (
        random.normal(0, 0.4, shape).astype(np.float32) for shape in shapes
    )
    box = np.array([[-1.0, -0.5, 0.25], [-1 + 16 / 8, -0.5 + 11 / 8, 0.25 + 13 / 8]])
    known: dict[str, Any] = {
        "links": links,
        "density": random.uniform(0, 12, n).astype(np.float32),
        "features": random.normal(0, 1, (n, 12)).astype(np.float32),
        "activation": Activation("softplus", -5.5, 8.0),
        "colour": MlpColour(first, first_bias, middle, middle_bias, last, last_bias, (1.0, 2.0, 4.0, 8.0)),
        "box": box,
        "at_corners": True,
        "occupied": held,
        "least": 1e-4,
    }
    return LatticeField(**(known | fields))


def files(lattice: LatticeField, **options: Any) -> dict[str, bytes]:
    return {name: b"".join(pieces) for name, pieces in form.encode(lattice, **options)}


def read(found: dict[str, bytes]) -> LatticeField:
    return form.decode({name: memoryview(data) for name, data in found.items()})


def values(lattice: LatticeField) -> tuple[Any, Any]:
    """Raw densities and features of all nodes, zeros where there is no row."""
    held = lattice.links >= 0
    density, features = np.zeros(held.shape, np.float32), np.zeros((*held.shape, 12), np.float32)
    density[held] = lattice.density[lattice.links[held]]
    features[held] = lattice.features[lattice.links[held]]
    return density, features


def test_what_is_written_is_what_is_read() -> None:
    lattice = some()
    found = read(files(lattice))
    for one, other in zip(values(found), values(lattice), strict=True):
        assert_array_equal(one, other)
    assert found.activation[:2] == lattice.activation[:2]
    assert_allclose(found.activation.scale, lattice.activation.scale, rtol=1e-14)
    assert (found.least, found.at_corners) == (lattice.least, True)
    assert_array_equal(found.box, lattice.box)
    assert_array_equal(found.occupied, lattice.occupied)
    assert isinstance(found.colour, MlpColour)
    assert isinstance(lattice.colour, MlpColour)
    for name in ("first", "first_bias", "middle", "middle_bias", "last", "last_bias", "frequencies", "direct"):
        assert_array_equal(getattr(found.colour, name), getattr(lattice.colour, name), err_msg=name)


def test_merged_it_is_the_same_in_halves_and_smaller() -> None:
    lattice = some()
    merged = files(lattice, merged=True)
    assert set(merged) == {"fine_last.tar", "mergedidxs.vdb", "mergeddata.npz"}
    found = read(merged)
    for one, other in zip(values(found), values(lattice), strict=True):
        assert_array_equal(one, other.astype(np.float16).astype(np.float32))
    assert found.dialect == "PlenVDB, merged"
    assert sum(map(len, merged.values())) < sum(map(len, files(lattice).values()))


def test_a_block_without_rows_is_a_tile_and_no_leaf() -> None:
    for name, data in files(some()).items():
        if name.endswith(".vdb"):
            for grid in openvdb.decode(memoryview(data)).grids:
                assert grid.topology.tile_counts == (1, 0, 0)
                assert grid.topology.voxel_count == np.prod(SHAPE)
                assert_array_equal(grid.topology.tile_cubes[0].low, [[0, 0, 0]])


def test_another_programs_mlp_is_written_as_it_is() -> None:
    """A checkpoint of DirectVoxGO, dense, its features 0 to 2 added to what the MLP makes, becomes the same folder."""
    whole = dvgo.decode(memoryview(dvgo_file(plenvdb(shape=(9, 9, 10)))))
    cube = replace(whole, box=np.array([[0.0, 0, 0], [8, 8, 9]]), activation=whole.activation._replace(scale=1.0))
    assert isinstance(cube.colour, MlpColour)
    cube = replace(cube, colour=replace(cube.colour, first=cube.colour.first[:, 3:], direct=False))
    found = read(files(cube))
    assert isinstance(found.colour, MlpColour)
    assert not found.colour.direct
    assert_array_equal(found.features, cube.features)
    assert_array_equal(found.density, cube.density)
    assert found.activation == cube.activation


def test_colours_without_an_mlp_are_written() -> None:
    lattice = some()
    plain = replace(lattice, colour=RgbColour(), features=np.ascontiguousarray(lattice.features[:, :3]), occupied=None)
    found = read(files(plain))
    assert isinstance(found.colour, RgbColour)
    assert found.occupied is not None
    assert found.occupied.all()


# -- PlenVDB's own libraries -----------------------------------------------------------------------------------
# Its program's model in torch's words, after docs/formats/checkpoints.md: it takes a state only if all keys are there.
_THEIRS = """
import json, sys, numpy, pyopenvdb as vdb, torch
folder, points, way = sys.argv[1], *map(json.loads, sys.argv[2:])
saved = torch.load(folder + "/fine_last.tar")
told, state = saved["model_kwargs"], saved["model_state_dict"]
low, high = torch.Tensor(told["xyz_min"]), torch.Tensor(told["xyz_max"])
base = ((high - low).prod() / told["num_voxels_base"]).pow(1 / 3)
size = ((high - low).prod() / told["num_voxels"]).pow(1 / 3)
shape = ((high - low) / size).long().tolist()
class Box(torch.nn.Module):
    def __init__(self, **more):
        super().__init__()
        for name, value in more.items():
            self.register_buffer(name, value)
class Model(Box):
    def __init__(self):
        k, W, pe = told["rgbnet_dim"], told["rgbnet_width"], told["viewbase_pe"]
        super().__init__(xyz_min=low, xyz_max=high, act_shift=torch.zeros(1), viewfreq=torch.zeros(pe))
        corners = {"xyz_min": low, "xyz_max": high}
        self.density, self.k0 = Box(**corners), Box(**corners)
        inner = [torch.nn.Sequential(torch.nn.Linear(W, W), torch.nn.ReLU()) for _ in range(told["rgbnet_depth"] - 2)]
        first = torch.nn.Linear(k + 3 + 6 * pe, W)
        self.rgbnet = torch.nn.Sequential(first, torch.nn.ReLU(), *inner, torch.nn.Linear(W, 3))
        mask = torch.zeros(told["mask_cache_world_size"], dtype=torch.bool)
        self.mask_cache = Box(mask=mask, xyz2ijk_scale=torch.zeros(3), xyz2ijk_shift=torch.zeros(3))
model = Model()
model.load_state_dict(state, strict=True)
def dense(grid, channels):
    assert grid.evalActiveVoxelDim() == tuple(shape) and grid.activeVoxelCount() == numpy.prod(shape)
    array = numpy.zeros(shape if channels == 1 else (*shape, channels), numpy.float32)
    grid.copyToArray(array)
    return torch.tensor(array.reshape(*shape, channels)).permute(3, 0, 1, 2)[None]
(density,) = vdb.readAll(folder + "/finedensity.vdb")[0]
colours = vdb.readAll(folder + "/finecolor.vdb")[0]
assert [len(vdb.readAllGridMetadata(folder + "/finecolor.vdb"))] == [told["rgbnet_dim"] // 3]
raw, k0 = dense(density, 1), torch.cat([dense(grid, 3) for grid in colours], 1)
p = torch.tensor(points)
at = ((p - low) / (high - low)).flip(-1) * 2 - 1
def between(grid):
    return torch.nn.functional.grid_sample(grid, at.reshape(1, 1, 1, -1, 3), align_corners=True)[0, :, 0, 0].T
i = torch.round(p * model.mask_cache.xyz2ijk_scale + model.mask_cache.xyz2ijk_shift).long()
alpha = 1 - torch.exp(-torch.nn.functional.softplus(between(raw)[:, 0] + model.act_shift) * told["voxel_size_ratio"])
d = torch.tensor([way]).repeat(len(p), 1)
turned = (d[:, :, None] * model.viewfreq).flatten(1)
rgb = torch.sigmoid(model.rgbnet(torch.cat([between(k0), d, turned.sin(), turned.cos()], 1)))
print(json.dumps([size.item(), model.mask_cache.mask[tuple(i.T)].tolist(), alpha.tolist(), rgb.tolist()]))
"""


@pytest.mark.tools
@pytest.mark.slow
def test_torch_and_openvdb_make_of_a_folder_what_was_meant(torch: str, tmp_path: Path) -> None:
    lattice = some()
    save_folder(tmp_path / "vdb_some", lattice)
    shares = np.random.default_rng(5).random((40, 3))
    points, way = lattice.box[0] + shares * (lattice.box[1] - lattice.box[0]), [2 / 7, -3 / 7, 6 / 7]
    given = [json.dumps(points.tolist()), json.dumps(way)]
    done = subprocess.run(
        [torch, "-c", _THEIRS, str(tmp_path / "vdb_some"), *given], capture_output=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr.decode()
    size, mask, alpha, colours = json.loads(done.stdout.decode().splitlines()[-1])
    # Where the mask is: what we make of it over one of their voxels; the opacity that is skipped is theirs to skip.
    ours = densities(nodes_of(replace(lattice, occupied=None, least=0.0, **filled(lattice))), shares)
    assert_allclose(1 - np.exp(-ours * size), alpha, atol=2e-6)
    assert any(mask)
    assert not all(mask)
    told = densities(nodes_of(load(tmp_path / "vdb_some", LatticeField)), shares)
    assert_array_equal(told[~np.array(mask)], 0)
    assert_allclose(colours, by_the_equations(lattice, points, way), atol=2e-6)


def filled(lattice: LatticeField) -> dict[str, Any]:
    """Rows of zeros where there are none."""
    density, features = values(lattice)
    links = np.arange(density.size, dtype=np.int32).reshape(density.shape)
    return {"links": links, "density": density.reshape(-1), "features": features.reshape(-1, 12)}


# -- its equations ---------------------------------------------------------------------------------------------
def by_the_equations(lattice: LatticeField, points: Any, way: list[float]) -> Any:
    """sigmoid(MLP([k0, d, sin, cos])) of features between the nodes, in plain NumPy."""
    _, features = values(lattice)
    at = (points - lattice.box[0]) / (lattice.box[1] - lattice.box[0]) * (np.array(lattice.shape) - 1)
    low = np.floor(at).astype(int)
    k0 = np.zeros((len(points), 12))
    for corner in np.ndindex(2, 2, 2):
        node = np.minimum(low + corner, np.array(lattice.shape) - 1)
        share = np.prod(np.where(corner, at - low, 1 - (at - low)), axis=1)
        k0 += share[:, None] * features[tuple(node.T)]
    angles = (np.array(way)[:, None] * 2.0 ** np.arange(4)).reshape(-1)
    code = np.broadcast_to([*way, *np.sin(angles), *np.cos(angles)], (len(points), 27))
    mlp = lattice.colour
    assert isinstance(mlp, MlpColour)
    x = np.maximum(np.concatenate([k0, code], axis=1) @ mlp.first.T + mlp.first_bias, 0)
    for weight, bias in zip(mlp.middle, mlp.middle_bias, strict=True):
        x = np.maximum(x @ weight.T + bias, 0)
    return 1 / (1 + np.exp(-(x @ mlp.last.T + mlp.last_bias)))


def test_a_folder_read_back_is_what_its_equations_say() -> None:
    lattice = some()
    found = read(files(lattice))
    points = lattice.box[0] + np.random.default_rng(6).random((30, 3)) * (lattice.box[1] - lattice.box[0])
    places = places_of(found, points)
    way = [6 / 7, 2 / 7, 3 / 7]
    features = interpolate_rows(found.links, table_of(found), in_nodes(places, found.shape, True))
    seen = seen_along(found, np.array([way]))(features, np.zeros(30, np.int64))
    assert_allclose(seen, by_the_equations(lattice, points, way), atol=2e-6)


# -- what is refused -------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ({"activation": Activation("relu")}, "is from another program; allowed: softplus of raw densities"),
        ({"at_corners": False}, "is from another program; allowed: softplus"),
        ({"mask_box": np.array([[0.0] * 3, [1.0] * 3])}, "is from another program; allowed: softplus"),
        ({"colour": ShColour(4)}, "has colours of SH4, cut at 0; allowed: RGB, or an MLP of features and directions"),
        ({"box": np.array([[0.0] * 3, [16, 11, 26]])}, r"has 17x12x14 nodes over 16 x 11 x 26; allowed: the same node"),
    ],
)
def test_a_lattice_that_is_none_of_plenvdbs_is_refused(fields: dict[str, Any], problem: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidScene, match=problem):
        save_folder(tmp_path / "out", some(**fields))
    assert list(tmp_path.iterdir()) == []


def test_features_that_are_no_triples_are_refused() -> None:
    lattice = some()
    assert isinstance(lattice.colour, MlpColour)
    ten = replace(lattice.colour, first=np.ascontiguousarray(lattice.colour.first[:, 2:]))
    with pytest.raises(InvalidScene, match="has 10 features; allowed: a multiple of 3"):
        files(replace(lattice, colour=ten, features=np.ascontiguousarray(lattice.features[:, 2:])))


def test_what_cannot_be_merged_is_refused() -> None:
    lattice = some()
    with pytest.raises(
        InvalidScene, match="contains values above 65504; allowed: values that float16 can represent, or not"
    ):
        files(replace(lattice, density=np.full(lattice.n, 1e6, np.float32)), merged=True)
    with pytest.raises(InvalidScene, match=r"the mask has \(2, 2, 2\) nodes; allowed: \(17, 12, 14\)"):
        files(replace(lattice, occupied=np.ones((2, 2, 2), bool)), merged=True)


def test_writing_takes_no_more_memory_than_there_is() -> None:
    with memory_limit(1000), pytest.raises(MemoryLimit, match="the nodes as voxels"):
        files(some())
