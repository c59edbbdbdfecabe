"""Splats by seed, and files of them as other programs write them: compressed .ply, .spz 1 to 3, .splat, .sog."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from typing import Any

import numpy as np
import PIL.Image

from nerfbake import Splats
from nerfbake.formats.splat import ply
from nerfbake.kernels.maths.elementary import fibonacci

CHUNK = 256


def splats(n: int, *, degree: int = 2, seed: int = 0, antialiased: bool = False) -> Splats:
    random = np.random.default_rng(seed)
    quats = random.normal(size=(n, 4))
    arrays = (
        random.normal(size=(n, 3)),
        np.exp(random.normal(size=(n, 3)) - 4),
        quats / np.sqrt((quats * quats).sum(axis=1, keepdims=True)),
        random.uniform(0.05, 0.95, n),
        random.uniform(-0.7, 0.7, (n, (degree + 1) ** 2, 3)),
    )
    means, scales, turns, opacity, sh = (array.astype(np.float32) for array in arrays)
    return Splats(means, scales, turns, opacity, sh, antialiased)


def ply_text(elements: dict[str, tuple[int, list[str]]], order: str = "little") -> bytes:
    """A header. elements: by name the count and the properties, as `float x`."""
    lines = ["ply", f"format binary_{order}_endian 1.0"]
    for name, (count, properties) in elements.items():
        lines += [f"element {name} {count}", *(f"property {each}" for each in properties)]
    return "\n".join([*lines, "end_header\n"]).encode()


def text_ply(scene: Splats) -> bytes:
    """The rows of a 3DGS file as text."""
    header, _, rows = b"".join(ply.encode(scene)).partition(b"end_header\n")
    table = np.frombuffer(rows, "<f4").reshape(scene.n, -1)
    lines = "".join(" ".join(repr(float(value)) for value in row) + "\n" for row in table)
    return header.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + lines.encode()


def _table(data: bytes) -> tuple[bytes, list[tuple[str, str]], np.ndarray]:
    """The header above the properties, name and type of each property, and the rows of a 3DGS file in floats."""
    header, _, rows = data.partition(b"end_header\n")
    kinds = [line.split()[1:3] for line in header.decode().splitlines() if line.startswith("property")]
    columns = [(name, {"float": "<f4", "double": "<f8", "ushort": "<u2"}[kind]) for kind, name in kinds]
    return header.partition(b"property")[0], columns, np.frombuffer(rows, columns)


def _with_columns(data: bytes, columns: list[tuple[str, Any]], order: str = "little") -> bytes:
    """The same file with these columns, by name."""
    head = _table(data)[0].replace(b"little", order.encode())
    kinds = {"f4": "float", "f8": "double", "u2": "ushort", "f2": "ushort"}
    text = "".join(f"property {kinds[np.asarray(each).dtype.str[1:]]} {name}\n" for name, each in columns)
    end = {"little": "<", "big": ">"}[order]
    rows = np.empty(len(columns[0][1]), [(name, end + np.asarray(each).dtype.str[1:]) for name, each in columns])
    for name, each in columns:
        rows[name] = each
    return head + text.encode() + b"end_header\n" + rows.tobytes()


def halved(data: bytes, which: str = "", order: str = "little") -> bytes:
    """The same file with the numbers whose names start with this as half floats, declared as ushort."""
    _, names, rows = _table(data)
    kept = [(name, rows[name].astype("<f2" if name.startswith(which) else "<f4")) for name, _ in names]
    return _with_columns(data, kept, order)


def farther(data: bytes, shift: np.ndarray) -> bytes:
    """The same file with x y z as doubles, moved."""
    _, names, rows = _table(data)
    moved = {axis: rows[axis].astype("<f8") + shift[k] for k, axis in enumerate("xyz")}
    return _with_columns(data, [(name, moved.get(name, rows[name])) for name, _ in names])


def with_property(data: bytes, declared: str) -> bytes:
    """The same file with one more property of zeros, as `float motion_0`."""
    _, names, rows = _table(data)
    kind, name = declared.split()
    zeros = np.zeros(len(rows), {"float": "<f4", "ushort": "<u2"}[kind])
    return _with_columns(data, [*((each, rows[each]) for each, _ in names), (name, zeros)])


def packed_ply(scene: Splats) -> bytes:
    """PlayCanvas' compressed kind, with bounds of colours and SH in bytes."""
    n, each = scene.n, scene.B - 1
    chunks, words = [], []
    for start in range(0, n, CHUNK):
        part = slice(start, start + CHUNK)
        columns = (scene.means[part], np.log(scene.scales[part]), scene.sh[part, 0] * 0.28209479 + 0.5)
        shares = []
        for values in columns:
            low, high = values.min(axis=0), values.max(axis=0)
            chunks.append([low, high])
            shares.append((values - low) / np.maximum(high - low, 1e-9))
        place, size = (_packed(share, (11, 10, 11)) for share in shares[:2])
        colour = _packed(np.concatenate([shares[2], scene.opacity[part, None]], axis=1), (8, 8, 8, 8))
        words.append(np.stack([place, _smallest_three(scene.quats[part]), size, colour], axis=1))
    kinds = (("", "xyz"), ("scale_", "xyz"), ("", "rgb"))
    bounds_of = [f"float {end}_{kind}{axis}" for kind, axes in kinds for end in ("min", "max") for axis in axes]
    header = ply_text({
        "chunk": (len(words), bounds_of),
        "vertex": (n, [f"uint packed_{name}" for name in ("position", "rotation", "scale", "color")]),
        "sh": (n, [f"uchar f_rest_{k}" for k in range(3 * each)]),
    })  # fmt: skip
    rest = np.clip((scene.sh[:, 1:].swapaxes(1, 2) / 8 + 0.5) * 256, 0, 255).astype(np.uint8)
    bounds = np.array(chunks, "<f4").tobytes()
    return header + bounds + np.concatenate(words).astype("<u4").tobytes() + rest.tobytes()


def _packed(shares: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    words = np.zeros(len(shares), np.uint32)
    for share, count in zip(shares.T, bits, strict=True):
        words = words << count | np.rint(share * ((1 << count) - 1)).astype(np.uint32)
    return words


def _smallest_three(quats: np.ndarray) -> np.ndarray:
    words = []
    for quat in quats:
        which = int(np.abs(quat).argmax())
        three = np.delete(quat * (-1 if quat[which] < 0 else 1), which)
        codes = np.rint((three / np.sqrt(2) + 0.5) * 1023).astype(int)
        words.append(which << 30 | int(codes[0]) << 20 | int(codes[1]) << 10 | int(codes[2]))
    return np.array(words, np.uint32)


def gzip_spz(scene: Splats, version: int, *, bits: int = 12) -> bytes:
    """Version 1 to 3, in the file's own axes: nothing is turned."""
    n = scene.n
    whole = np.rint(scene.means * 2.0**bits).astype("<i4")
    places = scene.means.astype("<f2") if version == 1 else whole.view(np.uint8).reshape(n, 3, 4)[..., :3]
    turns = scene.quats[:, 1:] * np.where(scene.quats[:, :1] < 0, -1, 1)
    codes = [
        scene.opacity * 255,
        (scene.sh[:, 0] * 0.15 + 0.5) * 255,
        (np.log(scene.scales) + 10) * 16,
        (turns + 1) * 127.5,
    ]
    parts = [np.clip(np.rint(each), 0, 255).astype(np.uint8).tobytes() for each in codes]
    if version == 3:
        parts[3] = b"".join(struct.pack("<I", _signed_three(quat)) for quat in scene.quats)
    parts.append(np.clip(np.rint(scene.sh[:, 1:] * 128 + 128), 0, 255).astype(np.uint8).tobytes())
    head = struct.pack("<4sIIBBBB", b"NGSP", version, n, scene.degree, bits, int(scene.antialiased), 0)
    return gzip.compress(head + places.tobytes() + b"".join(parts), mtime=0)


def packed_glb(scene: Splats, version: int = 2, name: str = "KHR_gaussian_splatting_compression_spz_2") -> bytes:
    """A .glb with a whole .spz instead of accessors with numbers."""
    blob = gzip_spz(scene, version)
    blob += bytes(-len(blob) % 4)
    base = "KHR_gaussian_splatting"
    look = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "extensions": {name: {"bufferView": 0}}}
    size = len(gzip_spz(scene, version))
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": [base, name],
        "extensionsRequired": [base, name],
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"mode": 0, "attributes": {"POSITION": 0}, "extensions": {base: look}}]}],
        "accessors": [{"componentType": 5126, "count": scene.n, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": size}],
        "buffers": [{"byteLength": len(blob)}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(blob), len(text), b"JSON")
    return head + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob


def ksplat(parts: list[Splats], level: int, *, ends: tuple[float, float] = (-1.5, 1.5)) -> bytes:
    """Sections of a .ksplat, each with full buckets of four splats and a partial one."""
    total = sum(part.n for part in parts)
    head = struct.pack("<BBxxIIIIH", 0, 1, len(parts) + 1, len(parts), total, total, level).ljust(36, b"\0")
    head += struct.pack("<ff", *ends)
    heads, data = b"", b""
    centres, small, coded = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))[level]
    for part in parts:
        full, left = divmod(part.n, 4)
        buckets = full + (left > 0)
        middles = np.stack([part.means[4 * k : 4 * k + 4].mean(axis=0) for k in range(buckets)]).astype("<f4")
        block = 4 * float(np.abs(part.means - middles.repeat(4, axis=0)[: part.n]).max())
        fields = (part.n, part.n, 4, buckets, block, 12, 32767, 12 * buckets, full, int(left > 0), part.degree)
        heads += struct.pack("<IIIIfHxxIIIIH", *fields).ljust(1024, b"\0")
        rest = np.concatenate(
            [part.sh[:, d * d : (d + 1) ** 2].swapaxes(1, 2).reshape(part.n, -1) for d in range(1, part.degree + 1)]
            or [np.zeros((part.n, 0), np.float32)],
            axis=1,
        )
        rest = np.rint((rest - ends[0]) / (ends[1] - ends[0]) * 255).clip(0, 255) if level == 2 else rest
        row = [("mean", centres, 3), ("scale", small, 3), ("quat", small, 4), ("colour", "u1", 4)]
        rows = np.zeros(part.n, [*row, ("sh", coded, (rest.shape[1],))])
        away = np.rint((part.means - middles.repeat(4, axis=0)[: part.n]) * (2 * 32767 / block)) + 32767
        rows["mean"] = away if level else part.means
        rows["scale"], rows["quat"], rows["sh"] = part.scales, part.quats, rest
        colour = np.concatenate([part.sh[:, 0] * 0.28209479 + 0.5, part.opacity[:, None]], axis=1)
        rows["colour"] = np.rint(colour * 255).clip(0, 255)
        data += struct.pack("<I", left) * (left > 0) + middles.tobytes() + rows.tobytes()
    return head.ljust(4096, b"\0") + heads + bytes(1024) + data  # the last section is empty


def spark_spz(scene: Splats, tree: list[tuple[int, int]], version: int = 2) -> bytes:
    """Levels of detail as Spark writes them. tree: the number of children of each row, and its first child."""
    whole = bytearray(gzip.decompress(gzip_spz(scene, version)))
    whole[14] |= 0x80
    alphas = 16 + 9 * scene.n
    whole[alphas : alphas + scene.n] = np.floor(scene.opacity * 127.5 + 0.5).astype(np.uint8).tobytes()
    counts, starts = zip(*tree, strict=True)
    whole += np.array(counts, "<u2").tobytes() + np.array(starts, "<u4").tobytes()
    return gzip.compress(whole, mtime=0)


def _signed_three(quat: np.ndarray) -> int:
    turn = [float(part) for part in (*quat[1:], quat[0])]
    which = max(range(4), key=lambda k: abs(turn[k]))
    word = which
    for k, part in enumerate(turn):
        if k != which:
            part = -part if turn[which] < 0 else part
            word = word << 10 | (part < 0) << 9 | round(abs(part) * 2**0.5 * 511)
    return word


def ball_of_splats(n: int = 400, *, degree: int = 0) -> Splats:
    """Opaque flat splats on a ball of radius 1, red towards x, green towards y, blue towards z."""
    places = fibonacci(n)
    # Half a turn about the axis between z and the normal leads from z to the normal.
    axes = places + np.array([0, 0, 1 + 1e-9])
    axes /= np.sqrt((axes * axes).sum(axis=1, keepdims=True))
    size = 1.5 / np.sqrt(n)
    sh = np.zeros((n, (degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = places / 2 / 0.28209479
    return Splats(
        places.astype(np.float32),
        np.tile(np.array([size, size, size / 5], np.float32), (n, 1)),
        np.concatenate([np.zeros((n, 1)), axes], axis=1).astype(np.float32),
        np.full(n, 0.95, np.float32),
        sh,
    )


def splat_rows(scene: Splats) -> bytes:
    """A .splat: means and scales as they are, all else in bytes."""
    rows = np.zeros(scene.n, [("mean", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("quat", "u1", 4)])
    rows["mean"], rows["scale"] = scene.means, scene.scales
    colour = np.concatenate([scene.sh[:, 0] * 0.28209479 + 0.5, scene.opacity[:, None]], axis=1)
    rows["colour"] = np.clip(np.rint(colour * 255), 0, 255)
    rows["quat"] = np.clip(np.rint(scene.quats * 128 + 128), 0, 255)
    return rows.tobytes()


def webp(pixels: np.ndarray) -> bytes:
    """(H, W, 4) bytes as a lossless WebP, with the colours of transparent pixels."""
    file = io.BytesIO()
    PIL.Image.fromarray(pixels).save(file, "WEBP", lossless=True, exact=True)
    return file.getvalue()


def _rows_of_pixels(*columns: np.ndarray, width: int = 8) -> bytes:
    """A picture with a pixel for each row of up to four columns of bytes."""
    n = len(columns[0])
    pixels = np.full((-(-n // width) * width, 4), 255, np.uint8)
    for k, column in enumerate(columns):
        pixels[:n, k] = column
    return webp(pixels.reshape(-1, width, 4))


def sog_files(scene: Splats, *, version: int = 2) -> dict[str, bytes]:
    """The files of a .sog, without k-means: codebooks are evenly spaced, and each splat is an entry of the palette."""
    t = np.sign(scene.means) * np.log1p(np.abs(scene.means))
    low, high = t.min(axis=0), t.max(axis=0)
    whole = np.rint((t - low) / np.maximum(high - low, 1e-9) * 65535).astype(int)
    turns = [_smallest_of(quat) for quat in scene.quats]
    dc, rest = scene.sh[:, 0], scene.sh[:, 1:]
    logits = np.log(scene.opacity / (1 - scene.opacity))
    files = {
        "means_l.webp": _rows_of_pixels(*(whole % 256).T),
        "means_u.webp": _rows_of_pixels(*(whole // 256).T),
        "quats.webp": _rows_of_pixels(*np.array(turns).T),
    }
    meta: dict[str, Any] = {
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "quats": {"files": ["quats.webp"]},
    }
    together = version == 2
    scales, meta["scales"] = _coded(np.log(scene.scales), together)
    colours, meta["sh0"] = _coded(dc if together else np.concatenate([dc, logits[:, None]], axis=1), together)
    files["scales.webp"] = _rows_of_pixels(*scales.T)
    alphas = [np.rint(scene.opacity * 255)] if together else []
    files["sh0.webp"] = _rows_of_pixels(*colours.T, *alphas)
    names = {"scales": ["scales.webp"], "sh0": ["sh0.webp"]}
    if scene.B > 1:
        codes, meta["shN"] = _coded(rest.reshape(-1, 1), together)
        if not together:
            meta["shN"] = {key: value[0] for key, value in meta["shN"].items()}
        palette = np.full((-(-scene.n // 64) * 64, scene.B - 1, 4), 255, np.uint8)
        palette[: scene.n, :, :3] = codes.reshape(scene.n, scene.B - 1, 3)
        numbers = np.arange(scene.n)
        files["shN_centroids.webp"] = webp(palette.reshape(-1, 64 * (scene.B - 1), 4))
        files["shN_labels.webp"] = _rows_of_pixels(numbers % 256, numbers // 256)
        names["shN"] = ["shN_centroids.webp", "shN_labels.webp"]
        if together:
            meta["shN"] |= {"bands": scene.degree, "count": scene.n}
    for key, own in names.items():
        meta[key]["files"] = own
    if together:
        meta |= {"version": 2, "count": scene.n, "antialias": scene.antialiased}
    else:
        meta["means"]["shape"] = [scene.n, 3]
    return {**files, "meta.json": json.dumps(meta).encode()}


def reference(file: int, offset: int, count: int) -> dict[str, int]:
    """Rows of one of the files in a lod-meta.json."""
    return {"file": file, "offset": offset, "count": count}


PARTS = {"0_0": splats(9, degree=1), "1_0": splats(5, degree=1, seed=1), "env": splats(3, degree=0, seed=2)}
TREE: dict[str, Any] = {
    "children": [
        {"lods": {"0": reference(0, 0, 4), "1": reference(1, 0, 2)}},
        {"children": [{"lods": {"1": reference(1, 2, 3)}}, {"lods": {"0": reference(0, 6, 3)}}]},
    ]
}


def sog_levels(parts: dict[str, Splats] = PARTS, tree: dict[str, Any] = TREE, **more: Any) -> dict[str, bytes]:
    """A scene of several levels, with a folder for each part."""
    files = {f"{name}/{file}": data for name, part in parts.items() for file, data in sog_files(part).items()}
    meta = {"lodLevels": 2, "filenames": [f"{name}/meta.json" for name in parts], "tree": tree, **more}
    return {**files, "lod-meta.json": json.dumps(meta).encode()}


def sog_zip(files: dict[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name), data)
    return file.getvalue()


def _coded(values: np.ndarray, together: bool) -> tuple[np.ndarray, dict[str, Any]]:
    """Bytes, and the codebook of all columns, or the minimum and the maximum of each."""
    low, high = (values.min(axis=None if together else 0), values.max(axis=None if together else 0))
    codes = np.rint((values - low) / (high - low) * 255).astype(np.uint8)
    if together:
        return codes, {"codebook": (low + (high - low) * np.arange(256) / 255).tolist()}
    return codes, {"mins": low.tolist(), "maxs": high.tolist()}


def _smallest_of(quat: np.ndarray) -> list[int]:
    which = int(np.abs(quat).argmax())
    three = np.delete(quat * (-1 if quat[which] < 0 else 1), which)
    return [*(round((float(part) * 2**0.5 + 1) / 2 * 255) for part in three), 252 + which]
