"""--max-memory means the peak: no load takes more than it was allowed, whether it is refused or not."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as Pillow

from nerfbake import build_octree, build_vdb, catalog, sample_n3tree, save
from nerfbake.formats.mesh.glb_writer import MeshPart, encode_glb
from nerfbake.formats.wire import zstd
from nerfbake.scene.image import Depth
from nerfbake.scene.mesh import Mesh
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from tests.support.large_files import FILES as OTHERS
from tests.support.lattices import SHAPE
from tests.support.n3trees import archive, svox
from tests.support.peaks import Peaks
from tests.support.tensorf import tensorf, tensorf_file
from tests.support.torch_files import dvgo, dvgo_file

SLACK = 8 << 20  # bytes that the interpreter itself may take meanwhile; docs/reliance.md promises 16 MiB

Maker = Callable[[Path], Any]


def chain(n: int = 400_000, data_dim: int = 4) -> SparseVoxelOctree:
    """All eight children of every node, as far as there are nodes."""
    parents = -(-(n - 1) // 8)
    children = np.zeros((n, 8), np.int32)
    children.reshape(-1)[: n - 1] = np.arange(1, n)
    assert children[parents:].sum() == 0
    return SparseVoxelOctree((512,) * 3, children, np.ones((n, data_dim), np.float32), "RGBA")


def octree(name: str, **options: Any) -> Maker:
    return lambda path: save(path, replace(chain(), data_format="" if name == "npz" else "RGBA"), **options)


def shuffled(path: Path) -> None:
    """Nodes in another order, -1 for no child: both are made right after reading."""
    whole = chain()
    order = np.concatenate([[0], 1 + np.random.default_rng(0).permutation(whole.n - 1)])
    rank = np.argsort(order)
    children = np.where(whole.node_children > 0, rank[whole.node_children], -1)[order].astype(np.int32)
    save(path, whole)
    with np.load(path) as old:
        np.savez(path, **{**old, "node_children": children})


def tree(path: Path, *, child: Any = np.int32, deflated: bool = False, **dtypes: Any) -> None:
    """Offsets of a whole tree; or none, which fit into a byte and are widened on reading."""
    n = 500_000
    offsets = np.zeros(8 * n, np.int32)
    if child != np.int8:
        offsets[: n - 1] = np.arange(1, n) - np.arange(n - 1) // 8
    cells = np.ones((n, 2, 2, 2, 4), np.float16)
    arrays = svox(N3Tree(offsets.reshape(n, 2, 2, 2), cells, np.full(3, 0.5), np.ones(3), "RGBA"))
    arrays["child"] = arrays["child"].astype(child)
    arrays |= {key: arrays[key].astype(dtype) for key, dtype in dtypes.items()}
    (np.savez_compressed if deflated else np.savez)(path, **arrays)


def quantised(path: Path) -> None:
    n, B = 100_000, 9
    shape = (n, 2, 2, 2)
    codes = np.random.default_rng(0).integers(0, 256, (B, *shape)).astype(np.uint16)
    np.savez(
        path, child=np.zeros(shape, np.int32), invradius3=np.ones(3, np.float32), offset=np.zeros(3, np.float32),
        data_format=np.array("SH9"), quant_colors=np.ones((B, 256, 3), np.float16), quant_map=codes,
        sigma=np.ones(shape, np.float16),
    )  # fmt: skip


def picture(mode: str, edge: int = 3000) -> Maker:
    def make(path: Path) -> None:
        pixels = np.random.default_rng(0).integers(0, 8, (edge, edge), np.uint8)
        grey = Pillow.fromarray(pixels.astype(np.uint16)) if mode == "I;16" else Pillow.fromarray(pixels)
        (grey if mode == "I;16" else grey.convert(mode)).save(path, "PNG", compress_level=1)

    return make


def polygons(path: Path) -> None:
    """A corner in every two bytes."""
    path.write_bytes(b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + (b"f" + b" 1 2 3" * 20 + b"\n") * 20_000)


def vertices(path: Path) -> None:
    path.write_bytes(b"v 0 0 0\n" * 400_000 + b"f 1 2 3\n" * 200_000)


def fan(path: Path) -> None:
    n = 500_000
    corners = np.arange(n, dtype=np.uint32)
    faces = np.stack([np.zeros(n - 2, np.uint32), corners[1:-1], corners[2:]], axis=1)
    mesh = Mesh(np.ones((n, 3), np.float32), None, faces, colours=np.ones((n, 3), np.float32))
    path.write_bytes(b"".join(encode_glb([MeshPart("a", mesh, {})], "test")))


def mixed_json(path: Path) -> None:
    """Whole numbers among the floats, each as short as can be."""
    whole = chain(100_000)
    fields = {"width": 512, "height": 512, "depth": 512, "node_children": whole.node_children.reshape(-1).tolist()}
    path.write_text(json.dumps(fields | {"node_data": [1] * 400_000}, separators=(",", ":")))


def spaces(path: Path) -> None:
    """A few kilobytes that unpack to 40 MB of JSON, most of it spaces."""
    octree = path.with_name("octree.svo.json")
    save(octree, chain(1000), profile="bulk")
    path.write_bytes(b"".join(zstd.compress([octree.read_bytes(), b" " * 40_000_000])))


def volume(**options: Any) -> Maker:
    grids = options.pop("grids")

    def make(path: Path) -> None:
        made = build_vdb(build_octree(sample_n3tree(resolution=128, basis="SH4")), grids=grids)
        save(path, made, **options)

    return make


def plenoxels(path: Path) -> None:
    n = 300_000
    links = np.random.default_rng(0).permutation(n).astype(np.int64).reshape(60, 50, 100)
    arrays = {"links": links, "density_data": np.ones((n, 1), np.float64), "sh_data": np.ones((n, 12), np.float64)}
    path.write_bytes(archive(arrays))


def voxels(path: Path) -> None:
    """Grids in halves, which are widened."""
    checkpoint, shape = dvgo(mlp="none"), (60, 50, 100)
    for name, channels in (("density", 1), ("k0", 3)):
        checkpoint["model_state_dict"][f"{name}.grid"] = np.ones((1, channels, *shape), np.float16)
    path.write_bytes(dvgo_file(checkpoint))


def planes(path: Path) -> None:
    """Planes and lines, whose products take a thousand times more than they do."""
    checkpoint, shape = tensorf(mode="SH", masked=False), (60, 50, 100)
    edges = dict(zip(SHAPE, shape, strict=True))
    for key, array in list(checkpoint["state_dict"].items()):
        if "_plane" in key or "_line" in key:
            size = (*array.shape[:2], *(edges.get(edge, 1) for edge in array.shape[2:]))
            checkpoint["state_dict"][key] = np.ones(size, np.float32)
    path.write_bytes(tensorf_file(checkpoint))


OCTREES_AND_MORE: dict[str, Maker] = {
    "full.svo.npz": octree("svo.npz"),
    "shuffled.svo.npz": shuffled,
    "report.svo.pb": octree("svo.pb", profile="report", no_child=-1),
    "bulk.svo.pb": octree("svo.pb", profile="bulk"),
    "report.svo.json": octree("svo.json", profile="report"),
    "bulk.svo.json": octree("svo.json", profile="bulk"),
    "mixed.svo.json": mixed_json,
    "spaces.svo.json.zst": spaces,
    "report.svo.bson": octree("svo.bson", profile="report"),
    "bulk.svo.bson": octree("svo.bson", profile="bulk"),
    "report.svo.fb": octree("svo.fb", profile="report"),
    "bulk.svo.capnp": octree("svo.capnp", profile="bulk", no_child=-1),
    "full.svo.pb.zst": octree("svo.pb"),
    "stored.npz": tree,
    "bytes.npz": lambda path: tree(path, child=np.int8),
    "deflated.npz": lambda path: tree(path, deflated=True),
    "swapped.npz": lambda path: tree(path, child=">i4", data=">f2"),
    "quantised.npz": quantised,
    "deflated.ckpt.npz": plenoxels,
    "half.tar": voxels,
    "planes.th": planes,
    "grey.png": picture("L"),
    "palette.png": picture("P"),
    "colour.png": picture("RGB"),
    "alpha.png": picture("RGBA"),
    "grey.depth.png": picture("I;16"),
    "plain.depth.npy": lambda path: save(path, Depth(np.ones((3000, 3000), np.float32))),
    "polygons.obj": polygons,
    "vertices.obj": vertices,
    "fan.glb": fan,
    "sh.vdb": volume(grids=("density", "sh")),
    "index.nvdb": volume(grids=("index",)),
    "zip.nvdb": volume(grids=("index",), codec="zip"),
    "sh.vdb.npz": volume(grids=("density", "sh")),
}


# By format of the catalog; of the names above, by their extensions.
FILES = {(form, name): make for form, makers in OTHERS.items() for name, make in makers.items()}
FILES |= {("", name): make for name, make in OCTREES_AND_MORE.items()}


@pytest.fixture(scope="module")
def peaks() -> Iterator[Peaks]:
    server = Peaks()
    yield server
    server.close()


def test_every_reader_is_measured() -> None:
    endings = tuple(name for _, name in FILES)
    forms = [
        form for form in catalog.FORMATS if form.readable and not any(name.endswith(form.suffix) for name in endings)
    ]
    assert [form.name for form in forms] == []
    assert {kind.name for kind in catalog.FOLDERS} <= {form for form, _ in FILES}


@pytest.mark.long
@pytest.mark.parametrize(("form", "name"), FILES)
def test_no_load_takes_more_than_it_may(form: str, name: str, tmp_path: Path, peaks: Peaks) -> None:
    FILES[form, name](tmp_path / name)
    found = peaks.measured(tmp_path / name)
    assert not found[-1][2], "is refused whatever it may take"
    assert [(limit >> 20, peak >> 20) for limit, peak, _ in found if peak > limit + SLACK] == []
