"""Files and folders of which reading takes 30 MB or more, by formats of the catalog, to measure that memory."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from PIL import Image as Pillow

from nerfbake import save
from nerfbake.formats.atlas import folder as atlas_folder
from nerfbake.formats.mesh import usda as mesh_usda
from nerfbake.formats.mesh.glb_writer import MeshPart, encode_glb
from nerfbake.formats.octree import svoq
from nerfbake.formats.splat import glb, ply, spz, usdc, usdz
from nerfbake.formats.wire.picture import encode_texture
from nerfbake.formats.wire.torch_writer import torch_file
from nerfbake.formats.wire.zstd import compress
from nerfbake.scene.atlas import BakedAtlas, OctahedralAtlas
from nerfbake.scene.mesh import Mesh, Meshes
from tests.support import environments, kplanes, merf, mobilenerf_scenes, nerfstudio, snapshots, snerg, torch_ngp
from tests.support.atlas_scenes import mlp_json
from tests.support.meshes import polygon_ply, sphere
from tests.support.plenvdb import merged_folder, plenvdb, plenvdb_folder
from tests.support.quantised import random_quantised
from tests.support.splats import (
    gzip_spz,
    ksplat,
    packed_ply,
    sog_files,
    sog_levels,
    sog_zip,
    spark_spz,
    splat_rows,
    splats,
)
from tests.support.splats import text_ply as text_splats

Maker = Callable[[Path], Any]
Files = dict[str, bytes]
_EDGE = 2000  # pixels of a texture
_MANY = 150_000  # splats
_FRAMES = 10_000


def _bytes(make: Callable[[], bytes]) -> Maker:
    return lambda path: path.write_bytes(make())


def _folder(make: Callable[[], Files]) -> Maker:
    def write(path: Path) -> None:
        for name, data in make().items():
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            (path / name).write_bytes(data)

    return write


# -- octrees and lattices --------------------------------------------------------------------------------------
def _svoq(coding: Any) -> Maker:
    octree = random_quantised
    return _bytes(lambda: b"".join(svoq.encode(octree(0, levels=9, data_format="SH1"), coding=coding)))


def _svraster() -> bytes:
    """All voxels of a level, whose corners all differ in value."""
    edge, levels = 40, 16
    cells = np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    paths = np.zeros(len(cells), np.int64)
    for step in range(1, 7):
        x, y, z = (cells >> (6 - step) & 1).T
        paths |= (x << 2 | y << 1 | z) << 3 * (levels - step)
    random = np.random.default_rng(0)
    return torch_file({
        "active_sh_degree": 1,
        "scene_center": np.zeros(3, np.float32),
        "scene_extent": np.ones(1, np.float32),
        "inside_extent": np.ones(1, np.float32),
        "octpath": paths[:, None],
        "octlevel": np.full((len(cells), 1), 6, np.int8),
        "_geo_grid_pts": random.normal(size=((edge + 1) ** 3, 1)).astype(np.float32),
        "_sh0": np.zeros((len(cells), 3), np.float32),
        "_shs": np.zeros((len(cells), 15, 3), np.float32),
        "quantized": False,
    })  # fmt: skip


def _merf() -> Files:
    """Planes of 1,024 x 1,024, beside few blocks."""
    with patch.object(merf, "PLANES", 1023):
        return merf.merf_folder(merf.merf())


def _snerg() -> Files:
    """Blocks of 31 voxels, and an atlas that is larger than they are."""
    with patch.multiple(snerg, BLOCK=30, GRID=(80, 60, 110), ATLAS=(100, 70, 68)):
        return snerg.snerg_folder(snerg.snerg())


# -- pictures --------------------------------------------------------------------------------------------------
def _picture(kind: str, mode: str = "RGB", edge: int = _EDGE, **options: Any) -> bytes:
    file = io.BytesIO()
    Pillow.new(mode, (edge, edge)).save(file, kind, **options)
    return file.getvalue()


def _run_row(width: int) -> bytes:
    """A row of a Radiance picture: equal pixels, as runs."""
    channel = b"".join(bytes([128 + min(127, width - x), 9]) for x in range(0, width, 127))
    return b"\2\2" + struct.pack(">H", width) + channel * 4


_CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)


def _textured_glb(picture: bytes) -> bytes:
    """A triangle with this texture, as other programs write it."""
    mesh = Mesh(_CORNERS, _CORNERS[:, :2].copy(), np.array([[0, 1, 2]], np.uint32), np.zeros((2, 2, 3), np.uint8))
    return b"".join(encode_glb([MeshPart("a", mesh, {"diffuse": picture})], "test"))


def _textured_obj(path: Path) -> None:
    path.write_bytes(b"mtllib a.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")
    path.with_name("a.mtl").write_bytes(b"newmtl a\nmap_Kd a.png\n")
    path.with_name("a.png").write_bytes(_picture("PNG"))


def _atlas() -> Files:
    maps = np.zeros((300, 100, 100, 3), np.uint8)
    labels = np.zeros((1500, 1500), np.uint16)
    atlas = OctahedralAtlas("kmeans", maps, labels, None, 1, 1.0, None)
    return {name: b"".join(pieces) for name, pieces in atlas_folder.encode(BakedAtlas((atlas,), (None,), {}, {}))}


def _thesis() -> Files:
    return {
        "octahedron_maps.png": _picture("PNG", edge=2000),
        "labels_map.png": _picture("PNG", edge=2000),
        "results.json": json.dumps({"final_clusters": 100, "mapping_resolution": 200}).encode(),
    }


def _stage1() -> Files:
    texture = encode_texture(np.zeros((_EDGE, _EDGE, 3), np.uint8))
    obj = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
    return {"mlp.json": mlp_json(), "feat0_0.png": texture, "feat1_0.png": texture, "mesh_0.obj": obj}


def _mobilenerf() -> Files:
    channels = mobilenerf_scenes.textures(edge=_EDGE)
    pictures = [encode_texture(np.ascontiguousarray(each)) for each in (channels[..., :4], channels[..., 4:])]
    files = {f"shape0.pngfeat{k}.png": picture for k, picture in enumerate(pictures)}
    return mobilenerf_scenes.phone_files(**files, **{"shape0.obj": mobilenerf_scenes.obj(edge=_EDGE)})


# -- meshes ----------------------------------------------------------------------------------------------------
def _unlike() -> bytes:
    """Polygons of three and of four corners, in binary."""
    text = polygon_ply([(0, 1, 2), (0, 2, 3, 1)] * 60_000)
    head, end, _ = text.partition(b"end_header\n")
    corners = struct.pack("<3f3B", 0, 0, 0, 9, 9, 9) * 4
    faces = struct.pack("<BB3i", 7, 3, 0, 1, 2) + struct.pack("<BB4i", 7, 4, 0, 2, 3, 1)
    return head.replace(b"ascii", b"binary_little_endian") + end + corners + faces * 60_000


def _alike(path: Path) -> None:
    corners = np.ones((100_000, 3), np.float32)
    save(path, Meshes((Mesh(corners, None, np.tile(np.arange(3, dtype=np.uint32), (300_000, 1))),)))


def _text_mesh() -> bytes:
    head = b"ply\nformat ascii 1.0\nelement vertex 100000\nproperty float x\nproperty float y\nproperty float z\n"
    face = b"element face 20000\nproperty list uchar int vertex_indices\nend_header\n"
    return head + face + b"0 0 1\n" * 100_000 + b"3 0 1 2\n" * 20_000


# -- splats ----------------------------------------------------------------------------------------------------
def _bomb_spz() -> bytes:
    """Splats of zeros in version 4, with as many bytes as they need."""
    n = 600_000
    packed = [b"".join(compress([bytes(each * n)])) for each in (9, 1, 3, 3, 4)]
    rows = struct.pack("<II", 1, 1 << 16)  # an extension that is left out
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, n, 0, 12, 2, 5, 32 + 8 + (1 << 16)) + rows + bytes(1 << 16)
    toc = b"".join(struct.pack("<QQ", len(each), size * n) for each, size in zip(packed, (9, 1, 3, 3, 4), strict=True))
    return head + toc + b"".join(packed)


def _moved_glb() -> bytes:
    """A node that turns the splats."""
    data = b"".join(glb.encode(splats(_MANY // 2, degree=2)))
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + size])
    document["nodes"][0]["rotation"] = [0.6, 0, 0, 0.8]
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    return b"glTF" + struct.pack("<IIII", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


def _sog() -> Files:
    return sog_files(splats(60_000, degree=1))


def _levels() -> Files:
    parts = {"0_0": splats(60_000, degree=1), "1_0": splats(30_000, degree=0), "env": splats(30_000, degree=0)}
    ranges = {"lods": {"0": {"file": 0, "offset": 0, "count": 60_000}}}
    return sog_levels(parts, {"children": [ranges, ranges]}, environment="env/meta.json")


def _zipped(name: str, data: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr(name, data)
    return file.getvalue()


def _ply() -> bytes:
    return b"".join(ply.encode(splats(_MANY // 2, degree=3)))


# -- cameras ---------------------------------------------------------------------------------------------------
def _transforms() -> bytes:
    frames = [{"file_path": f"images/{k}.png", "transform_matrix": np.eye(4).tolist()} for k in range(_FRAMES)]
    fields = {"w": 40, "h": 30, "fl_x": 50.0, "fl_y": 50.0, "cx": 20.0, "cy": 15.0, "frames": frames}
    return json.dumps(fields).encode()


def _colmap() -> Files:
    cameras = struct.pack("<QIiQQ4d", 1, 1, 1, 40, 30, 50.0, 50.0, 20.0, 15.0)
    rows = [struct.pack("<I7dI", k, 1, 0, 0, 0, k, 2, 3, 1) + b"%d.png\0" % k + bytes(8) for k in range(_FRAMES)]
    return {
        "sparse/0/cameras.bin": cameras,
        "sparse/0/images.bin": struct.pack("<Q", _FRAMES) + b"".join(rows),
    }


def _llff() -> Files:
    pose = np.concatenate([np.eye(3), [[1], [2], [3]], [[30], [40], [50]]], axis=1)
    file = io.BytesIO()
    np.save(file, np.tile([*pose.reshape(-1), 0.5, 9.5], (_FRAMES, 1)))
    return {"poses_bounds.npy": file.getvalue()} | {f"images/{k:05d}.png": _SMALL for k in range(_FRAMES)}


_SMALL = _picture("PNG", edge=2)


def _nsvf() -> Files:
    rows = "\n".join(" ".join(map(str, row)) for row in np.eye(4))
    files = {f"pose/{k:05d}.txt": rows.encode() for k in range(_FRAMES // 10)}
    files |= {f"rgb/{k:05d}.png": _SMALL for k in range(_FRAMES // 10)}
    return files | {"intrinsics.txt": b"50 20 15 0\n0 0 0\n1\n1\n30 40\n"}


# By format of the catalog: the name of a file or folder, and what writes it.
# -- networks --------------------------------------------------------------------------------------------------
def _halves() -> bytes:
    """A table in halves, which are widened."""
    root = nerfstudio.nerfacto("torch", log2=20)
    key = "_model.field.mlp_base.model.0.hash_table"
    root["pipeline"][key] = root["pipeline"][key].astype(np.float16)
    return nerfstudio.nerfstudio_file(root)


def _kplanes() -> bytes:
    root = kplanes.kplanes()
    shapes = {f"_model.field.grids.0.plane_coefs.{c}": (kplanes.CHANNELS, 1000, 1000) for c in range(3)}
    root["pipeline"] |= {key: np.ones(shape, np.float32) for key, shape in shapes.items()}
    return kplanes.kplanes_file(root)


FILES: dict[str, dict[str, Maker]] = {
    "ckpt": {
        "torch.ckpt": _bytes(lambda: nerfstudio.nerfstudio_file(nerfstudio.nerfacto("torch", log2=20))),
        "halves.ckpt": _bytes(_halves),
        "planes.ckpt": _bytes(_kplanes),
    },
    "ingp": {"packed.ingp": _bytes(lambda: gzip.compress(snapshots.snapshot_file(snapshots.snapshot(128)), 1))},
    "msgpack": {"bare.msgpack": _bytes(lambda: snapshots.snapshot_file(snapshots.snapshot(128)))},
    "pth": {"bits.pth": _bytes(lambda: torch_ngp.torch_ngp_file(torch_ngp.torch_ngp(128.0, occupied=[1], log2=20)))},
    "nerfstudio": {"run": _folder(lambda: nerfstudio.run_files(nerfstudio.nerfacto("torch", log2=20)))},
    "svoq": {"range.svoq": _svoq("range"), "deflate.svoq": _svoq("deflate")},
    "json": {"many.json": _bytes(_transforms)},
    "pt": {"level.pt": _bytes(_svraster)},
    "hdr": {
        "flat.hdr": _bytes(lambda: environments.HEAD % (1500, 3000) + bytes([9]) * 4 * 1500 * 3000),
        "runs.hdr": _bytes(lambda: environments.HEAD % (1000, 2000) + _run_row(2000) * 1000),
    },
    "obj": {"textured.obj": _textured_obj},
    "glb": {
        "png.glb": _bytes(lambda: _textured_glb(_picture("PNG"))),
        "palette.glb": _bytes(lambda: _textured_glb(_picture("PNG", "P"))),
        "jpeg.glb": _bytes(lambda: _textured_glb(_picture("JPEG", progressive=True, subsampling=0))),
        "webp.glb": _bytes(lambda: _textured_glb(_picture("WEBP", lossless=True))),
        "lossy webp.glb": _bytes(lambda: _textured_glb(_picture("WEBP", "RGBA"))),
        "splats.glb": _bytes(lambda: b"".join(glb.encode(splats(_MANY // 2, degree=2)))),
        "moved.glb": _bytes(_moved_glb),
    },
    "ply": {
        "unlike.ply": _bytes(_unlike),
        "alike.ply": _alike,
        "text.ply": _bytes(_text_mesh),
        "splats.ply": _bytes(_ply),
        "packed.ply": _bytes(lambda: packed_ply(splats(50_000, degree=1))),
        "text splats.ply": _bytes(lambda: text_splats(splats(20_000, degree=1))),
        "splats.ply.gz": _bytes(lambda: gzip.compress(_ply(), 1)),
        "splats.zip": _bytes(lambda: _zipped("a.ply", _ply())),
    },
    "spz": {
        "bomb.spz": _bytes(_bomb_spz),
        "degree 0.spz": _bytes(lambda: b"".join(spz.encode(splats(_MANY, degree=0)))),
        "degree 4.spz": _bytes(lambda: b"".join(spz.encode(splats(_MANY // 4, degree=4)))),
        "version 1.spz": _bytes(lambda: gzip_spz(splats(_MANY, degree=0), 1)),
        "version 2.spz": _bytes(lambda: gzip.decompress(gzip_spz(splats(_MANY, degree=1), 2))),
        "levels.spz": _bytes(lambda: spark_spz(splats(_MANY, degree=0), [(0, 0)] * _MANY)),
    },
    "sog": {
        "degree 1.sog": _bytes(lambda: sog_zip(_sog())),
        "levels.sog": _bytes(lambda: sog_zip(_levels())),
        "in its folder.sog": _bytes(lambda: sog_zip({f"a/{name}": data for name, data in _sog().items()})),
    },
    "usd": {"crate.usd": _bytes(lambda: b"".join(usdc.encode(splats(_MANY // 2, degree=2))))},
    "usdc": {"moved.usdc": _bytes(lambda: b"".join(usdc.encode(replace(splats(_MANY, degree=1), origin=np.ones(3)))))},
    "usda": {"mesh.usda": _bytes(lambda: b"".join(mesh_usda.encode(Meshes((sphere(300, 300),)))))},
    "usdz": {"half.usdz": _bytes(lambda: b"".join(usdz.encode(splats(_MANY // 2, degree=2), half=True)))},
    "ksplat": {
        "floats.ksplat": _bytes(lambda: ksplat([splats(_MANY, degree=0)], 0)),
        "bytes.ksplat": _bytes(lambda: ksplat([splats(_MANY // 2, degree=2)], 2)),
        "sections.ksplat": _bytes(lambda: ksplat([splats(_MANY // 2, degree=degree) for degree in (0, 1)], 1)),
    },
    "splat": {"many.splat": _bytes(lambda: splat_rows(splats(_MANY, degree=0)))},
    "sog_levels": {"sog_levels": _folder(_levels)},
    "stage1": {"stage1": _folder(_stage1)},
    "mobilenerf": {"mobilenerf": _folder(_mobilenerf)},
    "atlas": {"atlas": _folder(_atlas)},
    "thesis": {"thesis": _folder(_thesis)},
    "transforms": {"transforms": _folder(lambda: {"transforms.json": _transforms()})},
    "colmap": {"colmap": _folder(_colmap)},
    "llff": {"llff": _folder(_llff)},
    "nsvf": {"nsvf": _folder(_nsvf)},
    "plenvdb": {
        "full grids": _folder(lambda: plenvdb_folder(plenvdb(shape=(60, 50, 90)))),
        "merged": _folder(lambda: merged_folder(plenvdb(shape=(60, 50, 90)))),
    },
    "merf": {"merf": _folder(_merf)},
    "sog_folder": {"sog": _folder(_sog), "levels": _folder(_levels)},
    "snerg": {"snerg": _folder(_snerg)},
}  # fmt: skip
