"""torch's files without torch: a writer of the opcodes that torch 1.13 writes, and a checkpoint of DirectVoxGO.

Numbers, text, dicts, lists and tuples are what they are; arrays are written as tensors, each with a storage of its own;
what is to be a global, a NumPy array or anything else is given in opcodes, as Raw.
"""

from __future__ import annotations

import io
import struct
import zipfile
from typing import Any, NamedTuple

import numpy as np

from tests.support.lattices import CENTRE, RADIUS, SHAPE, affine

_STORAGES = {
    "f8": "Double", "f4": "Float", "f2": "Half", "i8": "Long", "i4": "Int", "i2": "Short", "i1": "Char", "u1": "Byte",
    "b1": "Bool",
}  # fmt: skip


class Raw(NamedTuple):
    """Opcodes that leave one value."""

    code: bytes


class View(NamedTuple):
    """A tensor that is a view of a storage: offset, size and stride in numbers; numel: what the pickle says of it."""

    values: Any
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]
    numel: int | None = None


def text(value: str) -> bytes:
    data = value.encode()
    return b"X" + struct.pack("<I", len(data)) + data


def glob(module: str, name: str) -> bytes:
    return b"c" + module.encode() + b"\n" + name.encode() + b"\n"


def numpy_array(array: Any) -> Raw:
    """As NumPy pickles itself in protocol 2: _reconstruct, then the state with bytes as latin-1 text."""
    array = np.asarray(array)
    kind = glob("numpy", "dtype") + text(array.dtype.str[1:]) + b"\x89\x88\x87R"
    kind += b"(K\x03" + text("<") + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    shape = b"(" + b"".join(_number(edge) for edge in array.shape) + b"t"
    data = glob("_codecs", "encode") + text(array.tobytes().decode("latin-1")) + text("latin1") + b"\x86R"
    made = (
        glob("numpy.core.multiarray", "_reconstruct") + glob("numpy", "ndarray") + b"K\x00\x85" + text("b") + b"\x87R"
    )
    return Raw(made + b"(K\x01" + shape + kind + b"\x89" + data + b"tb")


def ordered(items: dict[str, Any]) -> dict[str, Any]:
    """Marks a dict that is written as an OrderedDict."""
    return _Ordered(items)


class _Ordered(dict[str, Any]):
    pass


def _number(value: int) -> bytes:
    if 0 <= value < 256:
        return b"K" + bytes([value])
    if -(1 << 31) <= value < 1 << 31:
        return b"J" + struct.pack("<i", value)
    data = value.to_bytes(value.bit_length() // 8 + 1, "little", signed=True)
    return b"\x8a" + bytes([len(data)]) + data


class Writer:
    """Values to opcodes; storages by key, in the order in which they are met."""

    def __init__(self) -> None:
        self.storages: list[bytes] = []

    def code(self, value: Any) -> bytes:
        if isinstance(value, Raw):
            return value.code
        if value is None or isinstance(value, bool):
            return {None: b"N", True: b"\x88", False: b"\x89"}[value]
        if isinstance(value, int):
            return _number(value)
        if isinstance(value, float):
            return b"G" + struct.pack(">d", value)
        if isinstance(value, str):
            return text(value)
        if isinstance(value, tuple) and not isinstance(value, View):
            return b"(" + b"".join(map(self.code, value)) + b"t"
        if isinstance(value, list):
            return b"](" + b"".join(map(self.code, value)) + b"e"
        if isinstance(value, dict):
            begin = glob("collections", "OrderedDict") + b")R" if isinstance(value, _Ordered) else b"}"
            return begin + b"(" + b"".join(self.code(part) for item in value.items() for part in item) + b"u"
        return self._tensor(value if isinstance(value, View) else _whole(np.asarray(value)))

    def _tensor(self, view: View) -> bytes:
        values = np.asarray(view.values)
        kind = glob("torch", f"{_STORAGES[values.dtype.str[1:]]}Storage")
        key = text(str(len(self.storages)))
        self.storages.append(values.tobytes())
        numel = values.size if view.numel is None else view.numel
        storage = b"(" + text("storage") + kind + key + text("cuda:0") + _number(numel) + b"tQ"
        rest = self.code(view.offset) + self.code(view.size) + self.code(view.stride)
        hooks = glob("collections", "OrderedDict") + b")R"
        return glob("torch._utils", "_rebuild_tensor_v2") + b"(" + storage + rest + b"\x89" + hooks + b"tR"


def _whole(array: Any) -> View:
    stride = tuple(step // array.itemsize for step in np.zeros(array.shape, array.dtype).strides)
    return View(array.reshape(-1), 0, array.shape, stride)


def archive(
    pickle: bytes, storages: list[bytes], *, prefix: str = "archive", more: dict[str, bytes] | None = None
) -> bytes:
    """All members stored, as torch has them."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as made:
        members = {"data.pkl": pickle} | {f"data/{key}": data for key, data in enumerate(storages)}
        for name, data in (members | {"version": b"3\n"} | (more or {})).items():
            made.writestr(zipfile.ZipInfo(f"{prefix}/{name}"), data)
    return file.getvalue()


def torch_file(value: Any, **options: Any) -> bytes:
    writer = Writer()
    pickle = b"\x80\x02" + writer.code(value) + b"."
    return archive(pickle, writer.storages, **options)


# -- DirectVoxGO -----------------------------------------------------------------------------------------------
FEATURES, WIDTH = 4, 8
ACT_SHIFT = -9.0
BASE = 1000.0  # voxels


def dvgo(
    *,
    mlp: str = "affine",
    dialect: str = "grid",
    direct: bool = True,
    features: int = FEATURES,
    shape: tuple[int, int, int] = SHAPE,
) -> dict[str, Any]:
    """A checkpoint. mlp: affine, of which no relu ever cuts anything; random; none (three channels of colour).
    dialect: grid; early (before April 2022, without act_shift); 2021 (before February 2022, positions in the MLP);
    planes (features are products of planes and vectors)."""
    random = np.random.default_rng(4)
    low, high = (CENTRE - RADIUS).astype(np.float32), (CENTRE + RADIUS).astype(np.float32)
    axes = [np.linspace(a, b, edge) for a, b, edge in zip(low, high, shape, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    C = 3 if mlp == "none" else features + 3 * (not direct)
    k0 = random.normal(0, 0.5, (1, C, *shape)).astype(np.float32)
    dot = "" if dialect in ("early", "2021") else ".grid"
    state: dict[str, Any] = {
        "xyz_min": low,
        "xyz_max": high,
        f"density{dot}": affine(points).astype(np.float32)[None, None],
        f"k0{dot}": k0,
        "mask_cache.mask": np.ones((3, 4, 2), bool),
    }
    if dot:
        state["act_shift"] = np.array([ACT_SHIFT], np.float32)
    if mlp != "none":
        state |= weights(mlp, features, positions=dialect == "2021")
    settings = {
        "xyz_min": numpy_array(low),
        "xyz_max": numpy_array(high),
        "num_voxels": 4096,
        "num_voxels_base": int(BASE),
        "alpha_init": 1e-2,
        "voxel_size_ratio": np.float32(1.5),
        "fast_color_thres": {0: 1e-3, 1000: 1e-4},
        "rgbnet_dim": C,
        "rgbnet_direct": direct,
        "viewbase_pe": 4,
    }
    if dialect == "planes":
        del state["k0.grid"]
        state |= _planes(random, C, shape)
    if dialect == "2021":
        del state["mask_cache.mask"]
        state["mask_cache.density"] = np.ones((1, 1, 2, 2, 2), np.float32)
        flags = dict.fromkeys(("nearest", "pre_act_density", "in_act_density"), False)
        settings |= {"posbase_pe": 5, "mask_cache_path": "coarse_last.tar", **flags}
    optimizer = {"state": {0: {"exp_avg": View(np.zeros(1, np.float32), 0, (9,), (1,), numel=9)}}}
    return {
        "global_step": 20000,
        "model_kwargs": settings,
        "model_state_dict": ordered(state),
        "optimizer_state_dict": optimizer,
    }


def _planes(random: Any, channels: int, shape: tuple[int, int, int]) -> dict[str, Any]:
    """Of a TensoRFGrid with two parts each, three across x and y."""
    X, Y, Z = shape
    sizes = {"xy_plane": (3, X, Y), "xz_plane": (2, X, Z), "yz_plane": (2, Y, Z), "z_vec": (3, Z, 1)}
    sizes |= {"y_vec": (2, Y, 1), "x_vec": (2, X, 1)}
    made = {f"k0.{name}": random.normal(0, 1, (1, *size)).astype(np.float32) for name, size in sizes.items()}
    return made | {"k0.f_vec": random.normal(0, 0.5, (7, channels)).astype(np.float32)}


def weights(mlp: str, features: int = FEATURES, *, positions: bool = False) -> dict[str, Any]:
    """rgbnet of two hidden layers. affine: only features and d itself have weights in the first layer, and biases keep
    every unit on."""
    random = np.random.default_rng(5)
    layers = [
        random.normal(0, 0.3, shape) for shape in ((WIDTH, features + 27 + 33 * positions), (WIDTH, WIDTH), (3, WIDTH))
    ]
    biases = [random.normal(0, 0.3, len(layer)) for layer in layers]
    if mlp == "affine":
        layers[0][:, features + 3 :] = 0
        biases[0] += 20
        biases[1] += 200
        biases[2] -= layers[2] @ (layers[1] @ biases[0] + biases[1])
    named: dict[str, Any] = {}
    for name, layer, bias in zip(("rgbnet.0", "rgbnet.2.0", "rgbnet.3"), layers, biases, strict=True):
        named |= {f"{name}.weight": layer.astype(np.float32), f"{name}.bias": bias.astype(np.float32)}
    more = {"posfreq": np.array([1, 2, 4, 8, 16], np.float32)} if positions else {}
    return named | {"viewfreq": np.array([1, 2, 4, 8], np.float32)} | more


def dvgo_file(checkpoint: dict[str, Any] | None = None) -> bytes:
    return torch_file(dvgo() if checkpoint is None else checkpoint, prefix="fine_last")
