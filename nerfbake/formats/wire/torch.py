r"""Read files of torch.save (1.6 or newer) without torch and without pickle.

    <p>/data.pkl      the objects, a pickle               <p>/byteorder       little or big, since 2.1
    <p>/data/<key>    each storage's numbers, stored      anything else       ignored

<p> is the file's name, or `archive`. The local headers have no sizes; the central directory has them. Some writers
switch CRCs off, so a storage with a wrong CRC is read, and a note reports it. A storage is read on demand.

A pickle is a program. This module interprets only 32 opcodes, those that torch writes. They create dicts, lists,
tuples, text, numbers, and descriptions of tensors and arrays. Nothing is imported, no attribute is looked up and no
object of the file is called: a global must be a name in the table of torch_values.py, which contains its builder. Any
other opcode, global or argument raises InvalidFile with its offset in the file.

    80 02                       protocol 2                  63 "module\nname\n"    a global, by name
    7d 5d 29                    {}, [], ()                  51                     a storage, of ('storage', ...)
    28 .. 74 75 65              from a mark: tuple, items   52 81 62               build: of arguments, new, state
    85 86 87 61 73              tuples, append, set item    71 72 68 6a            memo: put, put, get, get
    58 u32, 55 u8               text                        4e 88 89               None, True, False
    4b 4d 4a 8a 47              u8, u16, i32, long, f64     2e                     the end

Source: Python's pickletools; torch's torch/_weights_only_unpickler.py, for what real files need.
"""

from __future__ import annotations

import math
import struct
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.torch_values import (
    BUILDERS,
    STORAGES,
    Array,
    Config,
    Dtype,
    Fault,
    Global,
    Storage,
    Tensor,
    fill,
    filled,
    order_in,
)
from nerfbake.formats.wire.zip_reader import ZipReader, npz_keys

MAX_OPCODES = 1 << 18  # real checkpoints have some thousands
_MOST_MADE = 1 << 12  # characters and items that builders may copy, in addition to the file's size in bytes


class _Mark:
    """The beginning of a tuple or of a group of items on the stack."""


_MARK = _Mark()


def read_pickle(data: bytes, name: str) -> Any:
    """Return the object of a pickle of protocol 2. name: the member's name, for errors. Raises InvalidFile."""
    return _Machine(data, name).run()


class _Machine:
    def __init__(self, data: bytes, name: str) -> None:
        self._data, self._name, self._at = data, name, 0
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}
        self._left = len(data) + _MOST_MADE

    def run(self) -> Any:
        for _ in range(MAX_OPCODES):
            place = self._at
            try:
                code = self._take(1)[0]
                if code == 0x2E:
                    return self._pop()
                step = _STEPS.get(code)
                if step is None:
                    raise Fault(f"has the opcode {code:02x}", "those that torch writes")
                step(self)
            except Fault as fault:
                raise self._refusal(place, fault) from None
        raise self._refusal(self._at, Fault(f"has more than {MAX_OPCODES:,} opcodes", "a checkpoint's"))

    def _refusal(self, place: int, fault: Fault) -> InvalidFile:
        return InvalidFile(Problem(f"{self._name} at byte {place:,}", fault.found, fault.allowed))

    # -- bytes and stack ---------------------------------------------------------------------------------------
    def _take(self, size: int) -> bytes:
        piece = self._data[self._at : self._at + size]
        if len(piece) < size:
            raise Fault("ends", "an opcode that ends it")
        self._at += size
        return piece

    def _number(self, layout: str) -> Any:
        return struct.unpack(layout, self._take(struct.calcsize(layout)))[0]

    def _line(self) -> str:
        end = self._data.find(b"\n", self._at, self._at + 256)
        if end < 0:
            raise Fault("has a name without an end", "at most 255 bytes and a line feed")
        return self._take(end + 1 - self._at)[:-1].decode("latin-1")

    def _text(self, size: int) -> str:
        try:
            return self._take(size).decode("utf-8", "surrogatepass")
        except UnicodeDecodeError:
            raise Fault("has text that is not UTF-8", "UTF-8") from None

    def _push(self, value: Any) -> None:
        self._stack.append(value)

    def _pop(self) -> Any:
        if not self._stack or isinstance(self._stack[-1], _Mark):
            raise Fault("pops a value from an empty stack", "a value that was pushed before")
        return self._stack.pop()

    def _since_mark(self) -> list[Any]:
        for at in range(len(self._stack) - 1, -1, -1):
            if isinstance(self._stack[at], _Mark):
                values = self._stack[at + 1 :]
                del self._stack[at:]
                return values
        raise Fault("ends a group without a mark", "a mark before it")

    # -- opcodes -----------------------------------------------------------------------------------------------
    def protocol(self) -> None:
        if (version := self._take(1)[0]) != 2:
            raise Fault(f"is of protocol {version}", "2, as torch writes it")

    def tuple_of(self, count: int) -> None:
        values = [self._pop() for _ in range(count)]
        self._push(tuple(reversed(values)))

    def long(self) -> None:
        self._push(int.from_bytes(self._take(self._take(1)[0]), "little", signed=True))

    def append(self, values: list[Any]) -> None:
        target = self._pop()
        if type(target) is not list:
            raise Fault("appends to a value that is not a list", "a list")
        target.extend(values)
        self._push(target)

    def set_items(self, values: list[Any]) -> None:
        target = self._pop()
        if not isinstance(target, dict) or len(values) % 2:
            raise Fault("sets items of a value that is not a dict", "a dict, a key and a value")
        fill(target, list(zip(values[::2], values[1::2], strict=True)))
        self._push(target)

    def put(self, number: int) -> None:
        value = self._pop()
        self._memo[number] = value
        self._push(value)

    def get(self, number: int) -> None:
        if number not in self._memo:
            raise Fault(f"reads memo entry {number:,}, which was never stored", "a stored entry")
        self._push(self._memo[number])

    def name_global(self) -> None:
        name = f"{self._line()} {self._line()}"
        if name not in BUILDERS and not (name.startswith("torch ") and name[6:] in STORAGES):
            raise Fault(f"names {name!r:.80}", "tensors, arrays, dicts; nerfbake never runs code of a file")
        self._push(Global(name))

    def persistent(self) -> None:
        match self._pop():
            case ("storage", Global(name), str(key), str(), int(count), *_) if name[6:] in STORAGES and count >= 0:
                self._push(Storage(STORAGES[name[6:]], key, count))
            case _:
                raise Fault("has an invalid storage", "('storage', type, key, location, count)")

    def reduce(self) -> None:
        arguments, what = self._pop(), self._pop()
        if not isinstance(what, Global) or what.name not in BUILDERS or type(arguments) is not tuple:
            raise Fault("calls a value that is not a global", "a global and its arguments")
        # Memo entries can be passed to builders repeatedly, and each call makes a copy.
        self._left -= len(arguments) + sum(len(each) for each in arguments if isinstance(each, str | list | dict))
        if self._left < 0:
            raise Fault("builds more than the file contains", "each text, list and dict about once")
        self._push(BUILDERS[what.name](arguments))

    def build(self) -> None:
        state, target = self._pop(), self._pop()
        if isinstance(target, Array):
            target.value = filled(state)
        elif isinstance(target, Dtype):
            target.order = order_in(state)
        elif not isinstance(target, Config):
            raise Fault("sets the state of a value that has none", "an array or a dict")
        self._push(target)


_STEPS: dict[int, Callable[[_Machine], None]] = {
    0x80: _Machine.protocol,
    0x7D: lambda machine: machine._push({}),
    0x5D: lambda machine: machine._push([]),
    0x29: lambda machine: machine._push(()),
    0x28: lambda machine: machine._push(_MARK),
    0x58: lambda machine: machine._push(machine._text(machine._number("<I"))),
    0x55: lambda machine: machine._push(machine._take(machine._number("<B")).decode("latin-1")),
    0x4A: lambda machine: machine._push(machine._number("<i")),
    0x4B: lambda machine: machine._push(machine._number("<B")),
    0x4D: lambda machine: machine._push(machine._number("<H")),
    0x8A: _Machine.long,
    0x47: lambda machine: machine._push(machine._number(">d")),
    0x4E: lambda machine: machine._push(None),
    0x88: lambda machine: machine._push(True),
    0x89: lambda machine: machine._push(False),
    0x74: lambda machine: machine._push(tuple(machine._since_mark())),
    0x85: lambda machine: machine.tuple_of(1),
    0x86: lambda machine: machine.tuple_of(2),
    0x87: lambda machine: machine.tuple_of(3),
    0x61: lambda machine: machine.append([machine._pop()]),
    0x65: lambda machine: machine.append(machine._since_mark()),
    0x73: lambda machine: machine.set_items([machine._pop(), machine._pop()][::-1]),
    0x75: lambda machine: machine.set_items(machine._since_mark()),
    0x71: lambda machine: machine.put(machine._number("<B")),
    0x72: lambda machine: machine.put(machine._number("<I")),
    0x68: lambda machine: machine.get(machine._number("<B")),
    0x6A: lambda machine: machine.get(machine._number("<I")),
    0x63: _Machine.name_global,
    0x51: _Machine.persistent,
    0x52: _Machine.reduce,
    0x81: _Machine.reduce,
    0x62: _Machine.build,
}


MAX_PICKLE = 16 << 20  # bytes: real checkpoints have some thousands
_WHAT = "a file as torch.save (1.6 or newer) writes it"
_LEGACY = bytes.fromhex("80028a0a6cfc9c46f920")  # first bytes of files of torch < 1.6
_PICKLE = "/data.pkl"
_NEWEST = 10  # version of the archive that torch reads
_HEAD = 1 << 20  # bytes at the start of the file that contain the start of the pickle


def is_torch(view: memoryview) -> bool:
    """True for an archive with a member <p>/data.pkl."""
    return any(name.endswith(_PICKLE) for name in npz_keys(view))


def mentions(view: memoryview, *names: bytes) -> bool:
    """True for an archive with a member <p>/data.pkl, whose start contains all these names."""
    return is_torch(view) and all(name in bytes(view[:_HEAD]) for name in names)


class TorchReader:
    """A file of torch.save: `root` is its object, array() returns the arrays in it, `notes` lists harmless findings."""

    def __init__(self, view: memoryview) -> None:
        if bytes(view[: len(_LEGACY)]) == _LEGACY:
            raise InvalidFile(f"is a file of torch before 1.6; allowed: {_WHAT} (load it with torch and save it again)")
        self._zip = ZipReader(view, _WHAT)
        self.notes: list[str] = []
        pickles = [name for name in self._zip.members if name.endswith(_PICKLE)]
        if len(pickles) != 1:
            raise InvalidFile(Problem("zip directory", f"lists {len(pickles)} members data.pkl", f"one, of {_WHAT}"))
        self._prefix = pickles[0].removesuffix(_PICKLE)
        order, version = self._small("byteorder"), self._small("version")
        if order not in (b"", b"little", b"big"):
            raise InvalidFile(Problem("byteorder", f"is {order[:40]!r}", "little or big"))
        if version and not (version.isdigit() and 1 <= int(version) <= _NEWEST):
            raise InvalidFile(Problem("version", f"is {version[:40]!r}", f"1 to {_NEWEST}"))
        self._big = order == b"big"
        size = self._zip.members[pickles[0]].file_size
        if size > MAX_PICKLE:
            raise InvalidFile(Problem("data.pkl", f"has {size:,} bytes", f"{MAX_PICKLE:,} at most"))
        memory.hold("data.pkl", 4 * size)  # a character takes up to 4 bytes in memory
        self.root = read_pickle(bytes(self._zip.unpacked(pickles[0], "data.pkl")), "data.pkl")

    def array(self, value: Any, name: str) -> npt.NDArray[Any]:
        """Return a tensor, an array or a number of the pickle as an array, if possible a view of the file.

        name: the name in error messages. Raises InvalidFile.
        """
        if isinstance(value, Tensor):
            return self._view_of(value, name)
        if isinstance(value, Array) and value.value is not None:
            return value.value.astype(value.value.dtype.newbyteorder("="), copy=False)
        if type(value) in (int, float, bool):
            if not abs(value) < 1 << 62:
                raise InvalidFile(Problem(name, "is too large, or not a number", "a number below 2^62"))
            return np.array(value)
        raise InvalidFile(Problem(name, "is not an array", "a tensor, an array or a number"))

    def _view_of(self, tensor: Tensor, name: str) -> npt.NDArray[Any]:
        storage = tensor.storage
        wide = storage.dtype == "bf16"
        kind = np.dtype("u2" if wide else storage.dtype).newbyteorder(">" if self._big else "<")
        raw = self._storage(storage.key, name)
        if len(raw) != storage.numbers * kind.itemsize:
            found = f"has {len(raw):,} bytes"
            raise InvalidFile(
                Problem(f"data/{storage.key:.40}", found, f"{storage.numbers * kind.itemsize:,} for {name}")
            )
        count = math.prod(tensor.size)
        last = tensor.offset + sum((edge - 1) * step for edge, step in zip(tensor.size, tensor.stride, strict=True))
        if not 0 < count <= storage.numbers or last >= storage.numbers:
            found = f"of shape {tensor.size} reaches number {last:,}"
            raise InvalidFile(Problem(name, found, f"the {storage.numbers:,} numbers of its storage"))
        steps = tuple(step * kind.itemsize for step in tensor.stride)
        array: npt.NDArray[Any] = np.ndarray(tensor.size, kind, raw, tensor.offset * kind.itemsize, steps)
        if wide:
            memory.hold(name, 4 * count)
            return (array.astype(np.uint32) << 16).view(np.float32)
        if kind == np.bool_:
            memory.hold(name, count)
            whole: npt.NDArray[Any] = array.view(np.uint8) != 0  # bytes other than 0 and 1 would be undefined as bool
            return whole
        if not kind.isnative:
            memory.hold(name, array.nbytes)
        return array.astype(kind.newbyteorder("="), copy=False)

    def _storage(self, key: str, name: str) -> memoryview:
        member = f"{self._prefix}/data/{key}"
        if member not in self._zip.members:
            raise InvalidFile(Problem(name, f"refers to data/{key:.40}, which is missing", "a member of the archive"))
        if self._zip.members[member].compress_type != zipfile.ZIP_STORED:
            raise InvalidFile(Problem(f"data/{key:.40}", "is compressed", "stored, as torch writes it"))
        raw = self._zip.unpacked(member, f"data/{key:.40}", damaged=True)
        note = f"{name} has another CRC-32 than the zip directory: it is damaged, or was written without a CRC"
        if note not in self.notes and not self._zip.is_whole(member, raw):
            self.notes.append(note)
        return raw

    def _small(self, name: str) -> bytes:
        member = f"{self._prefix}/{name}"
        if member not in self._zip.members or self._zip.members[member].file_size > 64:
            return b""
        return bytes(self._zip.unpacked(member, name)).strip()
