"""The pickle in a torch file, without pickle: a machine for the opcodes that torch writes, and for nothing else.

A pickle is a program. This machine knows 32 of its opcodes, and makes of them dicts, lists, tuples, text, numbers, and
descriptions of tensors and arrays. Nothing is imported, no attribute is looked up and nothing of the file's is called:
a global is a name in the table of torch_values.py, which has its builder; any other opcode, global or argument is
refused with its place in the file.

    80 02                       protocol 2                  63 "module\nname\n"    a global, by name
    7d 5d 29                    {}, [], ()                  51                     a storage, of ('storage', ...)
    28 .. 74 75 65              from a mark: tuple, items   52 81 62               build: of arguments, new, state
    85 86 87 61 73              tuples, append, set item    71 72 68 6a            memo: put, put, get, get
    58 u32, 55 u8               text                        4e 88 89               None, True, False
    4b 4d 4a 8a 47              u8, u16, i32, long, f64     2e                     the end

Source: Python's pickletools; torch's torch/_weights_only_unpickler.py, for what real files need.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

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
    fill,
    filled,
    order_in,
)

MAX_OPCODES = 1 << 18  # real checkpoints have some thousands
_MOST_MADE = 1 << 12  # characters and items that builders may copy, beside as many as the file has bytes


class _Mark:
    """Where a tuple, or some items, begin."""


_MARK = _Mark()


def read_pickle(data: bytes, name: str) -> Any:
    """What a pickle of protocol 2 says. name: the member's, for errors. Raises InvalidFile."""
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
            raise Fault("has a name without an end", "a line of 255 bytes at most")
        return self._take(end + 1 - self._at)[:-1].decode("latin-1")

    def _text(self, size: int) -> str:
        try:
            return self._take(size).decode("utf-8", "surrogatepass")
        except UnicodeDecodeError:
            raise Fault("has text that is no UTF-8", "UTF-8") from None

    def _push(self, value: Any) -> None:
        self._stack.append(value)

    def _pop(self) -> Any:
        if not self._stack or isinstance(self._stack[-1], _Mark):
            raise Fault("takes a value where there is none", "one that was put there before")
        return self._stack.pop()

    def _since_mark(self) -> list[Any]:
        for at in range(len(self._stack) - 1, -1, -1):
            if isinstance(self._stack[at], _Mark):
                values = self._stack[at + 1 :]
                del self._stack[at:]
                return values
        raise Fault("ends a group that has no beginning", "a mark before it")

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
            raise Fault("appends to what is no list", "a list")
        target.extend(values)
        self._push(target)

    def set_items(self, values: list[Any]) -> None:
        target = self._pop()
        if not isinstance(target, dict) or len(values) % 2:
            raise Fault("sets items of what is no dict", "a dict, a key and a value")
        fill(target, list(zip(values[::2], values[1::2], strict=True)))
        self._push(target)

    def put(self, number: int) -> None:
        value = self._pop()
        self._memo[number] = value
        self._push(value)

    def get(self, number: int) -> None:
        if number not in self._memo:
            raise Fault(f"asks for number {number:,}, which was never kept", "what was")
        self._push(self._memo[number])

    def name_global(self) -> None:
        name = f"{self._line()} {self._line()}"
        if name not in BUILDERS and not (name.startswith("torch ") and name[6:] in STORAGES):
            raise Fault(f"names {name!r:.80}", "tensors, arrays, dicts; nothing of a file is ever run")
        self._push(Global(name))

    def persistent(self) -> None:
        match self._pop():
            case ("storage", Global(name), str(key), str(), int(count), *_) if name[6:] in STORAGES and count >= 0:
                self._push(Storage(STORAGES[name[6:]], key, count))
            case _:
                raise Fault("names what is no storage", "('storage', type, key, location, count)")

    def reduce(self) -> None:
        arguments, what = self._pop(), self._pop()
        if not isinstance(what, Global) or what.name not in BUILDERS or type(arguments) is not tuple:
            raise Fault("builds something of what is no global", "a global and its arguments")
        # What was kept can be built from again and again: each time is a copy.
        self._left -= len(arguments) + sum(len(each) for each in arguments if isinstance(each, str | list))
        if self._left < 0:
            raise Fault("builds more than the file holds", "each text and each list about once")
        self._push(BUILDERS[what.name](arguments))

    def build(self) -> None:
        state, target = self._pop(), self._pop()
        if isinstance(target, Array):
            target.value = filled(state)
        elif isinstance(target, Dtype):
            target.order = order_in(state)
        elif not isinstance(target, Config):
            raise Fault("gives a state to what has none", "an array or a dict")
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
