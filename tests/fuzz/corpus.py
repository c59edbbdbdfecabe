"""Small valid files of every format, from our own encoders: the inputs that the fuzzer breaks."""

from __future__ import annotations

import base64
import gzip
import json
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from nerfbake import build_octree, build_vdb, catalog, fit_field
from nerfbake.batch.items import Item
from nerfbake.batch.report import save_plan
from nerfbake.batch.state import Attempt, InputRecord, ItemIdentity, OutputRecord, State
from nerfbake.formats.octree.svoq import CODINGS
from nerfbake.formats.wire.checkpoint import encode_checkpoint
from nerfbake.formats.wire.picture import encode_texture
from nerfbake.io.digests import Stamp
from nerfbake.scene.atlas import METHODS, BakedAtlas, Method
from nerfbake.scene.camera import Camera, Cameras, look_at
from nerfbake.scene.image import Depth, Image
from nerfbake.scene.mesh import Meshes
from nerfbake.scene.schedule import parse_schedule
from tests.conformance.gaussian_splatting.scenes import scenes
from tests.support import captures, environments, mobilenerf_scenes, nerfs
from tests.support.atlas_scenes import mlp_json, random_atlas, stage1_folder, texture
from tests.support.camera_tools import TOOLS, kept_by, write_meshroom, write_metashape, write_metashape_project
from tests.support.kplanes import kplanes, kplanes_file
from tests.support.lattices import svox2, svox2_file
from tests.support.merf import merf, merf_folder
from tests.support.meshes import ODD_OBJ, cube, odd_plys, polygon_ply, sparse_glb, square
from tests.support.meshopt_streams import CUBE, CUBE_KHR
from tests.support.n3trees import archive, held_out, quantised, svox
from tests.support.nerfstudio import nerfacto, nerfstudio_file, ngp, run_files
from tests.support.octrees import SPELLINGS, small_octree, written
from tests.support.plenvdb import merged_folder, plenvdb, plenvdb_folder
from tests.support.quantised import random_quantised
from tests.support.scenes import n3tree
from tests.support.snapshots import seen_by, snapshot, snapshot_file
from tests.support.snerg import snerg, snerg_folder
from tests.support.splats import (
    gzip_spz,
    halved,
    ksplat,
    packed_glb,
    packed_ply,
    sog_files,
    sog_levels,
    sog_zip,
    spark_spz,
    splat_rows,
    splats,
    text_ply,
    with_property,
)
from tests.support.svraster import svraster_file, voxels
from tests.support.tensorf import tensorf, tensorf_file
from tests.support.torch_files import dvgo, dvgo_file
from tests.support.torch_ngp import torch_ngp, torch_ngp_file
from tests.support.views import sample_views

Files = dict[str, bytes]

_NO_CHECKSUM = struct.pack("<Q", (1 << 64) - 1)
_CHECKSUM_AT = slice(8, 16)  # in NanoVDB's GridData
_MAP = np.array([453000.125, 5012345.5, 120.25])  # the origin of a scene in UTM


# Not formats of scenes, but files and folders that may come from untrusted sources.
CHECKPOINT = "checkpoint.npz"  # of a fit
LINES = "jobs.txt"  # of a batch
STATE = "state"  # of a batch that has run


def names() -> list[str]:
    """The readable formats, the kinds of folders, the cameras of other tools, and what a fit and a batch keep."""
    forms = [form.name for form in catalog.FORMATS if form.readable]
    forms += [kind.name for kind in (*catalog.FOLDERS, *catalog.DIALECTS)]
    return [*dict.fromkeys(forms), CHECKPOINT, LINES, STATE]


@cache
def files_of(name: str) -> tuple[bytes, ...]:
    """Valid files of a format."""
    if name == CHECKPOINT:
        return tuple(_checkpoints())
    if name == LINES:
        return (_JOBS.encode(), _JOBS.replace("\n", "\r\n").encode())
    if name == "usd":  # a crate or text
        return files_of("usda") + files_of("usdc")
    scenes = dict.fromkeys(form.scene for form in catalog.FORMATS if form.name == name and form.readable)
    makers: dict[str, Any] = {
        "SparseVoxelOctree": lambda: _compressed() if name == "svoq" else _octrees(name),
        "Volume": lambda: _volumes(name),
        "N3Tree": lambda: _voxels() if name == "pt" else _n3trees(),
        "Meshes": lambda: _meshes(name),
        "Splats": lambda: _splats(name),
        "EnvironmentMap": lambda: (environments.flat(), environments.runs()),
        "LatticeField": lambda: _lattices(name),
        "FunctionField": lambda: _functions(name),
    }
    pictures = (_encoded(name, each) for scene in scenes if scene not in makers for each in _pictures(scene))
    return (*(each for scene in scenes if scene in makers for each in makers[scene]()), *pictures)


@cache
def folders_of(name: str) -> tuple[Files, ...]:
    """Valid folders of a kind, as {file name: contents}."""
    makers = {
        "stage1": _stage1s,
        "mobilenerf": _phones,
        "atlas": _atlases,
        "thesis": _theses,
        "plenvdb": _plenvdbs,
        "merf": _merfs,
        "snerg": _snergs,
        "nerfstudio": _runs,
        "sog_folder": _sogs,
        "sog_levels": lambda: (sog_levels(), sog_levels(environment="env/meta.json")),
        STATE: _states,
    }
    return tuple(makers[name]() if name in makers else _captures(name))


def beside(name: str) -> Files:
    """Files that a format needs in its folder."""
    return {"kilonerf.yaml": nerfs.KILONERF_YAML.encode()} if name == "pth" else {}


def is_folder(name: str) -> bool:
    return name in [STATE, *(form.name for form in (*catalog.FOLDERS, *catalog.DIALECTS))]


def sound(name: str) -> tuple[bytes, ...] | tuple[Files, ...]:
    """Valid files or folders of a format."""
    return folders_of(name) if is_folder(name) else files_of(name)


def _encoded(name: str, scene: Any, **options: Any) -> bytes:
    forms = [form for form in catalog.FORMATS if form.name == name]
    wanted = type(scene).__name__
    form = next((form for form in forms if wanted in (form.scene, form.written)), forms[0])
    return b"".join(form.load_module().encode(scene, **options))


def _octrees(name: str) -> Iterator[bytes]:
    small = small_octree()
    lobes = replace(small, data_format="", node_data=small.node_data[:, :7])
    for spelling, profile in SPELLINGS:
        if spelling == name:
            yield written(name, profile, small)
            yield written(name, profile, small_octree(np.float16).with_layout("compact"), no_child=-1)
            yield written(name, profile, lobes)


def _compressed() -> Iterator[bytes]:
    for seed, data_format in enumerate(("SH4", "RGBA", "SH1")):
        octree = random_quantised(seed, levels=1 + seed, data_format=data_format)
        for coding in CODINGS:
            yield _encoded("svoq", octree, coding=coding)


def _checkpoints() -> Iterator[bytes]:
    """Checkpoints from the start, the middle and the end of a fit."""
    schedule = parse_schedule("cells=8,prune=0.03/cells=16,rays=2,prune=0.02/cells=16,split=0.2")
    states = fit_field(sample_views(frames=3, width=16, height=16), schedule=schedule, basis="SH1")
    for number, state in enumerate(states):
        if number in (0, 4, 8):
            yield b"".join(encode_checkpoint({"worked": 1.5, "curve": [[1, 2, 3, 4, 5, 6]]}, state.arrays()))


_JOBS = """# made by hand
svo scenes/chair.npz baked/chair.svo.pb --resolution 128
nerfbake vdb 'scenes/a tree.npz' \\
  baked/tree.vdb
render "scenes/x
y.npz" --out 'baked/x y.png'
"""


def _states() -> Iterator[Files]:
    """The state of a batch with three items: one is done, one has failed, and one waits."""
    names = [(f"{name}.npz", f"{name}.svo.pb") for name in "abc"]
    items = [Item(("svo", read, written), (read,), (written,)) for read, written in names]
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        state = State(folder)
        save_plan(folder, items)
        with state.opened("0-of-1", {"machine": "a machine", "python": "3.11", "nerfbake": "0.1.0"}, 1.0):
            for number, (item, status) in enumerate(zip(items, ("done", "failed"), strict=False)):
                identity = ItemIdentity(
                    f"{number:032x}", (InputRecord(item.reads[0], Stamp(3, 4, None), f"{number:064x}"),)
                )
                outputs = (OutputRecord(item.writes[0], 5, "0" * 64),)[: status == "done"]
                claims = state.begin(item, identity, 2.0)
                state.end(item, identity, Attempt(status, number, "no\n"[:number], 1.5, 9, 3, outputs, 31.5), claims)
        yield {path.name: path.read_bytes() for path in folder.iterdir()}


def _n3trees() -> Iterator[bytes]:
    tree = n3tree(splits=[(0, (0, 0, 0)), (1, (1, 1, 1))], data_format="SH4")
    yield archive(svox(tree))
    yield archive(svox(n3tree(splits=[(0, (2, 1, 0))], N=3, dtype=np.float32)), deflated=False)
    yield archive(quantised(), deflated=False)
    yield _encoded("npz", n3tree(held_out=held_out()))


def _voxels() -> Iterator[bytes]:
    """Checkpoints of SVRaster."""
    yield svraster_file(voxels(depth=3))
    yield svraster_file(voxels(1, depth=3, outside=2, degree=0), quantised=True)


def _lattices(name: str) -> Iterator[bytes]:
    """Lattices as other programs write them."""
    if name == "tar":
        yield dvgo_file(dvgo(mlp="random"))
        yield dvgo_file(dvgo(mlp="none", dialect="early"))
        yield dvgo_file(dvgo(mlp="random", dialect="2021"))
        yield dvgo_file(dvgo(mlp="random", dialect="planes"))
        return
    if name == "th":
        yield tensorf_file(tensorf())
        yield tensorf_file(tensorf(mode="SH", masked=False))
        return
    yield svox2_file(svox2(size=4, plain=False, empty=0.2))
    yield svox2_file(svox2(size=1), deflated=True)


def _functions(name: str) -> Iterator[bytes]:
    """Networks as other programs write them."""
    if name == "tar":
        yield nerfs.nerf_pytorch_file(nerfs.nerf_pytorch())
        yield nerfs.nerf_pytorch_file(None, nerfs.nerf_pytorch(directions=False))
    elif name == "ckpt":
        yield nerfs.vanilla_nerf_file(nerfs.vanilla_nerf())
        yield from (nerfstudio_file(nerfacto(layout)) for layout in ("torch", "tcnn", "tcnn 0.3"))
        yield nerfstudio_file(ngp())
        yield from (kplanes_file(kplanes(concatenated=apart, appearance=2)) for apart in (True, False))
    elif name == "pth":
        yield nerfs.kilonerf_file(nerfs.kilonerf())
        yield from (torch_ngp_file(torch_ngp(1.0, occupied=cells)) for cells in (None, [0, 77]))
    elif name == "ingp":
        yield gzip.compress(snapshot_file(snapshot(grid=[])), 1, mtime=0)
        yield gzip.compress(snapshot_file(snapshot(1)), 1, mtime=0)
        yield zlib.compress(snapshot_file(snapshot(grid=[], dataset=seen_by(2))), 1)
    elif name == "msgpack":
        yield snapshot_file(snapshot(grid=[], dataset=seen_by(2), half=False))
        yield from (nerfs.jaxnerf_file(nerfs.jaxnerf(colour=colour)) for colour in ("directions", "SH4", "SG"))


def _volumes(name: str) -> Iterator[bytes]:
    octree = build_octree(n3tree(splits=[(0, (0, 0, 0)), (0, (1, 0, 1))], data_format="SH4"))
    kinds: dict[str, list[tuple[str, ...]]] = {
        "vdb": [("density", "Cd"), ("density", "sh")],
        "nvdb": [("density",), ("index",), ("Cd",)],
        "vdb.npz": [("density", "sh"), ("index",)],
    }
    for grids in kinds[name]:
        for half in (False,) if grids == ("Cd",) else (False, True):  # NanoVDB has no half colours
            volume = build_vdb(octree, grids=grids, half=half)
            if name == "vdb.npz":
                yield _encoded(name, volume)
                continue
            plain = _encoded(name, volume, codec="none")
            yield _unchecked(plain) if name == "nvdb" else plain
            yield _encoded(name, volume, codec="zip")


def _unchecked(data: bytes) -> bytes:
    """Remove the checksum of a .nvdb: it would detect all damage before any other check."""
    at = data.index(b"NanoVDB0", 8)
    return data[: at + _CHECKSUM_AT.start] + _NO_CHECKSUM + data[at + _CHECKSUM_AT.stop :]


def _meshes(name: str) -> Iterator[bytes]:
    plain, flat = cube(), square(half=1.0)
    coloured = replace(cube(0.3), colours=np.linspace(0, 1, 24, dtype=np.float32).reshape(8, 3))
    yield _encoded(name, Meshes((plain, coloured)))
    yield _encoded(name, Meshes((flat,)))
    if name == "usdz":
        yield _encoded(name, Meshes((replace(flat, texture=texture(6, 5)), coloured)), up="z", image="jpeg")
    if name == "glb":
        textured = replace(flat, texture=texture(6, 5))
        yield _encoded(name, Meshes((textured, coloured)))
        painted = replace(textured, colours=np.linspace(0, 1, 12, dtype=np.float32).reshape(4, 3))
        yield _encoded(name, Meshes((painted,), (flat,)), quantised=True, lit=True, image="webp")
        yield sparse_glb()
        yield base64.b64decode(CUBE)
        yield base64.b64decode(CUBE_KHR)
    yield _encoded(name, Meshes((plain,), origin=_MAP))
    if name == "ply":
        yield polygon_ply([(0, 1, 2), (0, 2, 3, 1)])
        yield from odd_plys()
    if name == "obj":
        yield ODD_OBJ


def _splats(name: str) -> Iterator[bytes]:
    if name == "splat":
        yield splat_rows(splats(5))
        return
    if name == "ksplat":
        yield from (ksplat([splats(5, degree=1), splats(3, degree=0)], level) for level in range(3))
        return
    if name == "sog":
        yield from (sog_zip(files) for files in _sogs())
        yield _encoded(name, splats(5, degree=1))
        yield sog_zip({f"a/{name}": data for name, data in sog_files(splats(5, degree=0)).items()})
        return
    yield _encoded(name, splats(5))
    yield _encoded(name, splats(3, degree=0))
    if name == "ply":
        yield packed_ply(splats(300, degree=1))
        yield text_ply(splats(4, degree=0))
        yield _encoded(name, replace(splats(4, degree=0), origin=_MAP, up="z"))
        yield halved(_encoded(name, splats(3, degree=1)))
        yield halved(_encoded(name, splats(3, degree=1))).replace(b"ushort", b"half")
        yield with_property(with_property(_encoded(name, splats(3, degree=0)), "float trbf_center"), "float motion_0")
    elif name == "glb":
        yield _encoded(name, replace(splats(4, degree=0), origin=_MAP))
        yield packed_glb(splats(4, degree=1))
        yield from (scene.data for scene in scenes() if scene.name in ("node_uneven_matrix", "interleaved"))
    elif name.startswith("usd"):
        yield _encoded(name, replace(splats(4, degree=1), origin=_MAP, up="z"), half=True)
    elif name == "spz":
        yield _encoded(name, splats(4), axes="LFU", spz_version=3)
        yield from (gzip_spz(splats(4), version) for version in (1, 2, 3))
        yield gzip.decompress(gzip_spz(splats(4), 2))
        yield spark_spz(splats(4), [(2, 1), (0, 0), (1, 3), (0, 0)])


def _sogs() -> Iterator[Files]:
    """Both versions, and a scene of two levels."""
    yield sog_files(splats(9, degree=1))
    yield sog_files(splats(5, degree=0), version=1)
    yield sog_levels()


def _pictures(scene: str) -> Iterator[Any]:
    random = np.random.default_rng(5)
    colour, alpha = random.random((7, 9, 3), np.float32), random.random((7, 9), np.float32)
    if scene == "Image":
        yield Image(colour, np.ones_like(alpha), np.zeros_like(alpha))
        yield Image(colour * alpha[..., None], alpha, np.zeros_like(alpha), None)
    elif scene == "Depth":
        yield Depth(alpha * np.float32(3))
    else:
        views = [Camera(40, 30, 50.0, look_at(np.zeros(3), turn, 0.4, 3.0), f"r_{turn}") for turn in range(3)]
        yield Cameras(tuple(views))
        yield Cameras((replace(views[0], name="a/b"),))


def _stage1s() -> Iterator[Files]:
    small = {"feat1_0_png": encode_texture(texture(12, 9)), "feat0_0_png": encode_texture(texture(12, 9, seed=1))}
    transforms = {"transforms_json": _encoded("json", next(iter(_pictures("Cameras"))))}
    yield _written_folder(**small)
    yield _written_folder(**small, **transforms, mlp_json=mlp_json(cascade=2), feat1_1_png=small["feat1_0_png"])


def _phones() -> Iterator[Files]:
    yield mobilenerf_scenes.phone_files()
    parts = {
        "shape0.obj": None,
        "shape0_0.obj": mobilenerf_scenes.obj((0,)),
        "shape0_1.obj": mobilenerf_scenes.obj((1,)),
    }
    yield mobilenerf_scenes.phone_files(**parts)
    yield mobilenerf_scenes.phone_files(**{"shape0.obj": None})


def _written_folder(**files: bytes) -> Files:
    return _files_below(lambda folder: stage1_folder(folder / "stage1", **files))


def _files_below(write: Callable[[Path], Path]) -> Files:
    """Call a function that writes a folder and returns its path, and return {path in the folder: contents}."""
    with tempfile.TemporaryDirectory() as place:
        folder = write(Path(place))
        return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _captures(name: str) -> Iterator[Files]:
    """The cameras of a rig in the formats of other programs."""
    if name in TOOLS:
        for tool in (TOOLS[name][0], *_MORE_TOOLS.get(name, ())):
            yield _files_below(partial(_written_tool, tool, kept_by(name, captures.rig(odd=True))))
        return
    writers = {
        "transforms": (captures.write_nerf_synthetic, captures.write_instant_ngp, captures.write_nerfstudio),
        "colmap": (captures.write_colmap_binary, captures.write_colmap_text),
        "llff": (captures.write_llff,),
        "nsvf": (captures.write_nsvf,),
    }
    for odd in (False, True):
        for write in writers[name]:
            if not odd or write is not captures.write_nerf_synthetic:
                yield _files_below(partial(_written_capture, write, odd))


# Other spellings of a dialect.
_MORE_TOOLS: dict[str, tuple[Callable[..., str], ...]] = {
    "metashape": (write_metashape_project, partial(write_metashape, calibration="<b2>0.5</b2><k4>1e-3</k4>")),
    "meshroom": (partial(write_meshroom, version=(1, 0, 0)), partial(write_meshroom, version=(1, 2, 1))),
}


def _written_tool(write: Callable[..., str], made: captures.Rig, place: Path) -> Path:
    captures.write_pictures(place / "images", made)
    write(place, made)
    return place


def _written_capture(write: Callable[..., Path], odd: bool, place: Path) -> Path:
    write(place, captures.rig(odd=odd))
    return place


def _atlases() -> Iterator[Files]:
    module = catalog.folders_of("BakedAtlas")[0].load_module()
    methods: tuple[Method, ...] = METHODS
    for method in methods:
        mesh = replace(square(half=1.0), texture=texture(20, 30)) if method == "affine" else None
        baked = BakedAtlas((random_atlas(method),), (mesh,), {}, {})
        yield {name: b"".join(pieces) for name, pieces in module.encode(baked)}


def _plenvdbs() -> Iterator[Files]:
    """A folder with full grids, and a merged one."""
    yield plenvdb_folder(plenvdb(shape=(3, 4, 9)))
    yield merged_folder(plenvdb(shape=(4, 3, 5)))


def _snergs() -> Iterator[Files]:
    yield snerg_folder(snerg())
    yield snerg_folder(snerg(diffuse=True))


def _merfs() -> Iterator[Files]:
    yield merf_folder(merf())
    yield merf_folder(merf(planes=False))


def _runs() -> Iterator[Files]:
    """Runs of nerfstudio, one with the transforms.json of its capture."""
    capture = _encoded("json", next(iter(_pictures("Cameras"))))
    yield run_files(nerfacto("tcnn"), average_init_density=0.5)
    yield run_files(ngp()) | {"transforms.json": capture.replace(b"{", b'{"applied_scale": 2.0,', 1)}


def _theses() -> Iterator[Files]:
    random = np.random.default_rng(2)
    labels = np.zeros((6, 5, 3), np.uint8)
    labels[..., 0] = random.integers(0, 3, (6, 5))
    yield {
        "results.json": json.dumps({"final_clusters": 3, "mapping_resolution": 4}).encode(),
        "octahedron_maps.png": encode_texture(random.integers(0, 256, (8, 8, 3), np.uint8)),
        "labels_map.png": encode_texture(labels),
    }
