"""TensoRF's checkpoints: planes and lines against their own formula, torch's, and what is refused."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake import Camera, LatticeField, build_octree_from_lattice, load, memory_limit, render_lattice
from nerfbake.cli.main import run
from nerfbake.errors import MemoryLimit
from nerfbake.formats.field import tensorf as reader
from nerfbake.formats.wire.torch_writer import Raw, numpy_array
from nerfbake.kernels.lattice.nodes import densities, in_nodes, interpolate_rows
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.scene.lattice_field import MlpColour, ShColour
from nerfbake.stages._lattice import fit_of, nodes_of, places_of, seen_along, table_of
from tests.support.hostile import refused_as_it_is
from tests.support.lattices import CENTRE, RADIUS, SHAPE
from tests.support.scenes import world_centres
from tests.support.tensorf import MASK_BOX, colour_at, dense, density_at, in_mask, tensorf, tensorf_file

RANDOM = np.random.default_rng(1)
CORNERS = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]), -1).reshape(-1, 3)
POINTS = CENTRE.astype(float) + RADIUS * np.concatenate([RANDOM.uniform(-1, 1, (300, 3)), CORNERS])


def read(**options: Any) -> LatticeField:
    return reader.decode(memoryview(tensorf_file(tensorf(**options))))


def features_at(lattice: LatticeField, points: Any) -> Any:
    at = in_nodes(np.clip(places_of(lattice, points), 0, 1), lattice.shape, lattice.at_corners)
    return interpolate_rows(lattice.links, table_of(lattice), at)


def test_nodes_are_the_sums_of_products() -> None:
    checkpoint, lattice = tensorf(masked=False), read(masked=False)
    assert lattice.shape == SHAPE
    assert_allclose(lattice.density.reshape(SHAPE), dense(checkpoint, "density").sum(axis=0), atol=1e-5)
    weight = checkpoint["state_dict"]["basis_mat.weight"]
    expected = np.einsum("fr,rxyz->xyzf", weight, dense(checkpoint, "app"))
    assert_allclose(lattice.features.reshape(*SHAPE, -1), expected, atol=1e-5)
    assert (lattice.dialect, lattice.occupied) == ("TensoRF", None)


@pytest.mark.parametrize("act", ["softplus", "relu"])
def test_densities_are_those_of_its_planes_in_its_mask(act: str) -> None:
    """The mask's own box goes beyond the lattice's, and ends within it."""
    checkpoint, lattice = tensorf(act=act), read(act=act)
    inside = in_mask(checkpoint, POINTS)
    assert 20 < np.count_nonzero(inside) < 280
    found = densities(nodes_of(lattice), np.clip(places_of(lattice, POINTS), 0, 1))
    assert_allclose(found, density_at(checkpoint, POINTS), rtol=1e-5, atol=1e-5)
    assert np.count_nonzero(lattice.links < 0) > 20  # nodes that do not matter to what the mask holds
    octree = build_octree_from_lattice(lattice, basis="SH1")
    points = world_centres(octree)
    assert_allclose(octree.sample(points)[:, -1], density_at(checkpoint, points), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("mode", ["MLP_Fea", "MLP"])
def test_colours_are_those_of_its_mlp(mode: str) -> None:
    checkpoint, lattice = tensorf(mode=mode), read(mode=mode)
    points = POINTS[in_mask(checkpoint, POINTS)]
    features, directions = features_at(lattice, points), fibonacci(3)
    for ray, direction in enumerate(directions):
        seen = seen_along(lattice, directions)(features, np.full(len(points), ray))
        assert_allclose(seen, colour_at(checkpoint, points, direction), atol=1e-5)
    coefficients = fit_of(lattice, 25)(features).reshape(-1, 3, 25)
    shown = 1 / (1 + np.exp(-np.einsum("mcb,b->mc", coefficients, sh_basis(directions, 25)[1])))
    assert np.abs(shown - colour_at(checkpoint, points, directions[1])).mean() < 0.02


def test_its_harmonics_are_plenoxels() -> None:
    """max(0, 1/2 + sum Y c), the coefficients of red first."""
    checkpoint, lattice = tensorf(mode="SH"), read(mode="SH")
    assert lattice.colour == ShColour(9)
    points = POINTS[in_mask(checkpoint, POINTS)]
    shares = (points - CENTRE + RADIUS) / (2 * RADIUS)
    at = shares * (np.array(SHAPE) - 1)
    x, y, z = (np.maximum(1 - np.abs(at[:, [axis]] - np.arange(edge)), 0) for axis, edge in enumerate(SHAPE))
    grid = np.einsum("fr,rxyz->xyzf", checkpoint["state_dict"]["basis_mat.weight"], dense(checkpoint, "app"))
    wanted = np.einsum("xyzf,mx,my,mz->mf", grid, x, y, z).reshape(-1, 3, 9)
    directions = fibonacci(2)
    seen = seen_along(lattice, directions)(features_at(lattice, points), np.ones(len(points), np.int64))
    assert_allclose(seen, np.maximum(0.5 + wanted @ sh_basis(directions, 9)[1], 0), atol=1e-5)


def test_rays_that_meet_nothing_show_the_background() -> None:
    pose = np.eye(4)
    pose[:3, 3] = CENTRE + np.array([0, 0, 9])
    pose[:3, :3] = np.diag([1, -1, -1])  # looking away
    image = render_lattice(read(), Camera(3, 2, 4.0, pose, "away"), background=(0.25, 0.5, 1.0))
    assert_allclose(image.colour, np.broadcast_to([0.25, 0.5, 1.0], (2, 3, 3)))


def test_commands_take_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "chair.th"
    path.write_bytes(tensorf_file())
    assert run(["check", str(path)]) == 0
    capsys.readouterr()
    assert run(["info", str(path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["dialect"], told["resolution"], told["mask"]) == ("TensoRF", list(SHAPE), [5, 4, 6])
    (tmp_path / "renamed").write_bytes(tensorf_file())
    assert isinstance(load(tmp_path / "renamed"), LatticeField)
    lattice = load(path, LatticeField)
    large = lattice.scaled(2.0)
    assert large.mask_box is not None
    apart = (MASK_BOX[1] - MASK_BOX[0]).astype(float) / (3, 2, 4)
    assert_allclose(large.mask_box, 2 * np.stack([MASK_BOX[0] - apart, MASK_BOX[1] + apart]))
    assert (lattice.held_box[0] >= lattice.box[0]).all()
    assert (lattice.held_box[1] <= lattice.box[1]).all()


def test_a_lattice_takes_no_more_memory_than_there_is() -> None:
    """Planes of some kilobytes are a lattice of 400^3 nodes."""
    checkpoint = tensorf(masked=False)
    for key, array in list(checkpoint["state_dict"].items()):
        if "_plane" in key or "_line" in key:
            edges = [1, 1, *(400 if edge > 1 else 1 for edge in array.shape[2:])]
            checkpoint["state_dict"][key] = np.zeros(edges, np.float32)
    checkpoint["state_dict"]["basis_mat.weight"] = np.zeros((4, 3), np.float32)
    with memory_limit(100 << 20), pytest.raises(MemoryLimit, match="links needs"):
        reader.decode(memoryview(tensorf_file(checkpoint)))


# -- torch itself ----------------------------------------------------------------------------------------------
# Reads the file, and interpolates as its model does: grid_sample of planes and lines, and of the mask.
_ASKS = """
import json, sys, numpy, torch
import torch.nn.functional as F
file, points = torch.load(sys.argv[1], map_location="cpu"), torch.tensor(json.load(sys.stdin), dtype=torch.float32)
state, settings = file["state_dict"], file["kwargs"]
box = settings["aabb"]
at = (points - box[0]) * (2 / (box[1] - box[0])) - 1
across = torch.stack([at[:, [0, 1]], at[:, [0, 2]], at[:, [1, 2]]]).view(3, -1, 1, 2)
along = torch.stack([at[:, 2], at[:, 1], at[:, 0]])
along = torch.stack((torch.zeros_like(along), along), dim=-1).view(3, -1, 1, 2)
def parts(what):
    made = []
    for i in range(3):
        plane = F.grid_sample(state[f"{what}_plane.{i}"], across[[i]], align_corners=True).view(-1, len(points))
        line = F.grid_sample(state[f"{what}_line.{i}"], along[[i]], align_corners=True).view(-1, len(points))
        made.append(plane * line)
    return torch.cat(made)
density = 25 * F.softplus(parts("density").sum(dim=0) + settings["density_shift"])
shape, mask_box = file["alphaMask.shape"], file["alphaMask.aabb"]
mask = torch.from_numpy(numpy.unpackbits(file["alphaMask.mask"])[: numpy.prod(shape)].reshape(shape)).float()
where = ((points - mask_box[0]) * (2 / (mask_box[1] - mask_box[0])) - 1).view(1, -1, 1, 1, 3)
density[F.grid_sample(mask, where, align_corners=True).view(-1) <= 0] = 0
features = parts("app").T @ state["basis_mat.weight"].T
print(json.dumps({"density": density.tolist(), "features": features.tolist()}))
"""


@pytest.mark.tools
@pytest.mark.slow
def test_torch_makes_the_same_of_the_file(torch: str, tmp_path: Path) -> None:
    (tmp_path / "a.th").write_bytes(tensorf_file())
    asked = json.dumps(POINTS[:300].tolist())
    command = [torch, "-c", _ASKS, str(tmp_path / "a.th")]
    done = subprocess.run(command, input=asked, capture_output=True, text=True, check=True, timeout=120)
    theirs, lattice = json.loads(done.stdout), load(tmp_path / "a.th", LatticeField)
    density = densities(nodes_of(lattice), places_of(lattice, POINTS[:300]))
    assert_allclose(density, theirs["density"], rtol=1e-4, atol=1e-4)
    held = density > 0
    assert_allclose(features_at(lattice, POINTS[:300])[held], np.array(theirs["features"])[held], atol=1e-5)


# -- what is refused -------------------------------------------------------------------------------------------
def settings(**values: Any) -> Callable[[dict[str, Any]], None]:
    return lambda checkpoint: checkpoint["kwargs"].update(values)


def state(**values: Any) -> Callable[[dict[str, Any]], None]:
    named = {key.replace("__", "."): value for key, value in values.items()}
    return lambda checkpoint: checkpoint["state_dict"].update(named)


def mask(**values: Any) -> Callable[[dict[str, Any]], None]:
    return lambda checkpoint: checkpoint.update({f"alphaMask.{key}": value for key, value in values.items()})


def without(key: str, *more: str) -> Callable[[dict[str, Any]], None]:
    def change(checkpoint: dict[str, Any]) -> None:
        for each in (key, *more):
            del checkpoint["state_dict"][each]

    return change


def ones(*shape: int) -> Any:
    return np.ones(shape, np.float32)


NESTED = Raw(b"]" * 5000 + b"a" * 4999)  # lists in lists
PLANES = [f"density_plane.{i}" for i in range(3)]
LIES: dict[str, tuple[Callable[[dict[str, Any]], None], str]] = {
    "NDC": (settings(near_far=[0.0, 1.0]), "near_far is 0 to 1: a forward-facing scene (NDC)"),
    "NDC by its box": (settings(near_far=None, aabb=np.array([[-2, -2, -1], [2, 2, 1]], np.float32)), "scene (NDC)"),
    "lines alone": (without(*PLANES), "state_dict has density_line.0: lines alone (TensorCP)"),
    "the oldest": (lambda c: c.update(state_dict={"plane_coef": ones(1)}), "has plane_coef: the oldest model"),
    "no planes": (without("density_plane.1"), "state_dict has no density_plane.1; allowed: a model of TensoRF"),
    "no basis": (without("basis_mat.weight"), "state_dict has no basis_mat.weight"),
    "a flat plane": (state(density_plane__0=ones(5)), "density_plane.0 has shape (5,); allowed: (1, parts, nodes"),
    "whole numbers": (state(density_plane__0=np.ones((1, 2, 6, 5), np.int32)), "density_plane.0 has dtype int32"),
    "other nodes": (state(density_plane__2=ones(1, 2, 7, 5)), "plane.2 has shape (5, 7, 2), density_line.2 (5, 2)"),
    "other parts": (state(density_line__1=ones(1, 2, 6, 1)), "allowed: nodes of (5, 6, 7), and the same number"),
    "a broad line": (state(density_line__1=ones(1, 3, 6, 2)), "density_line.1 has shape (1, 3, 6, 2)"),
    "other lattices": (lambda c: _resized(c, "app", 1), "app_plane.0 has (4, 5, 6) nodes; allowed: (5, 6, 7)"),
    "a lattice too thin": (lambda c: _resized(c, "density", 4), "density_plane.0 is of a lattice of (1, 2, 3)"),
    "a narrow basis": (state(basis_mat__weight=ones(4, 5)), "basis_mat.weight is for (5,) parts; allowed: 6"),
    "a basis of none": (state(basis_mat__weight=ones(4)), "basis_mat.weight has shape (4,)"),
    "no box": (settings(aabb=3), "aabb has dtype int64"),
    "a box of one": (settings(aabb=ones(3)), "aabb has shape (3,); allowed: (2, 3)"),
    "a turned box": (settings(aabb=ones(2, 3)), "aabb is not a box; allowed: the lowest corner"),
    "a NaN box": (settings(aabb=np.nan * ones(2, 3)), "aabb is not a box"),
    "no shift": (settings(density_shift=None), "density_shift is not an array"),
    "two scales": (settings(distance_scale=ones(2)), "distance_scale has dtype float32, shape (2,)"),
    "another activation": (settings(fea2denseAct="exp"), "fea2denseAct is 'exp'; allowed: softplus or relu"),
    "positions": (settings(shadingMode="MLP_PE"), "shadingMode is 'MLP_PE', whose MLP takes positions as inputs; "),
    "bare colours": (settings(shadingMode="RGB"), "shadingMode is 'RGB', colours without a bound"),
    "no mode": (settings(shadingMode=None), "shadingMode is None; allowed: MLP_Fea, MLP or SH"),
    "SH of four": (settings(shadingMode="SH"), "basis_mat.weight has 4 rows; allowed: 27, for SH"),
    "a mode without an end": (settings(shadingMode=NESTED), "shadingMode is a list; allowed: MLP_Fea"),
    "frequencies in lists": (settings(fea_pe=NESTED), "fea_pe is a list; allowed: 0 to 16"),
    "an activation of lists": (settings(fea2denseAct=NESTED), "fea2denseAct is a list; allowed: softplus or relu"),
    "no frequencies": (settings(view_pe=None), "view_pe is None; allowed: 0 to 16"),
    "a million": (settings(fea_pe=10**6), "fea_pe is 1000000; allowed: 0 to 16"),
    "fewer inputs": (settings(view_pe=1), "renderModule.mlp.0 takes 43 inputs; allowed: 37, for 4 features"),
    "no layer": (without("renderModule.mlp.2.weight"), "has no renderModule.mlp.2.weight"),
    "a layer of another width": (state(renderModule__mlp__2__weight=ones(8, 7)), "renderModule.mlp.2 has weights of"),
    "a last layer of four": (state(renderModule__mlp__4__weight=ones(4, 8)), "the MLP's last has shape"),
    "a mask of text": (mask(shape="abc"), "alphaMask.shape is 'abc'; allowed: (Z, Y, X)"),
    "a mask of many": (mask(shape=(2, 5, 3, 4)), "alphaMask.shape is (2, 5, 3, 4)"),
    "a thin mask": (mask(shape=(1, 1, 60)), "alphaMask.shape is (1, 1, 60)"),
    "a huge mask": (mask(shape=(4096, 4096, 4096)), "alphaMask.mask has dtype uint8, shape (8,); allowed: uint8 (85"),
    "fewer bits": (mask(mask=numpy_array(np.zeros(7, np.uint8))), "alphaMask.mask has dtype uint8, shape (7,)"),
    "no bits": (mask(mask=None), "alphaMask.mask is not an array"),
    "no box of the mask": (mask(aabb=ones(2, 3)), "aabb is not a box"),
    "no settings": (lambda checkpoint: checkpoint.update(kwargs=3), "data.pkl has no kwargs; allowed: a checkpoint of"),
}  # fmt: skip


def _resized(checkpoint: dict[str, Any], what: str, less: int) -> None:
    """Planes and lines that have fewer nodes, along every axis."""
    for key, array in list(checkpoint["state_dict"].items()):
        if key.startswith((f"{what}_plane", f"{what}_line")):
            cut = [slice(None), slice(None), *(slice(max(1, e - less)) if e > 1 else slice(1) for e in array.shape[2:])]
            checkpoint["state_dict"][key] = np.ascontiguousarray(array[tuple(cut)])


@pytest.mark.parametrize("lie", LIES)
def test_a_lying_checkpoint_is_refused(lie: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change, expected = LIES[lie]
    checkpoint = tensorf()
    change(checkpoint)
    assert expected in refused_as_it_is(tmp_path / "bad.th", tensorf_file(checkpoint), capsys)


def test_a_value_that_is_no_number_is_found() -> None:
    checkpoint = tensorf()
    checkpoint["state_dict"]["density_line.0"][:] = np.nan
    lattice = reader.decode(memoryview(tensorf_file(checkpoint)))
    assert "density[0] is nan" in str(lattice.problems()[0])
    checkpoint = tensorf()
    checkpoint["kwargs"]["view_pe"], checkpoint["kwargs"]["fea_pe"] = 14, 0
    checkpoint["state_dict"]["renderModule.mlp.0.weight"] = ones(8, 4 + 3 + 84)
    lattice = reader.decode(memoryview(tensorf_file(checkpoint)))
    assert isinstance(lattice.colour, MlpColour)
    assert "frequencies[13] is 8192" in str(lattice.problems()[0])


def test_a_feature_without_a_sine_is_found() -> None:
    checkpoint = tensorf()
    checkpoint["state_dict"]["basis_mat.weight"] *= 1e7
    (problem,) = reader.decode(memoryview(tensorf_file(checkpoint))).problems()
    assert problem.place.startswith("colours[")
    assert "250000" in problem.allowed


def test_a_mask_that_holds_nothing_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = tensorf()
    checkpoint["alphaMask.mask"] = numpy_array(np.zeros(8, np.uint8))
    path = tmp_path / "empty.th"
    path.write_bytes(tensorf_file(checkpoint))
    assert run(["info", str(path)]) == 0
    assert run(["svo", str(path), str(tmp_path / "out.svo.pb"), "-q"]) == 1
    assert "is empty" in capsys.readouterr().err
