"""The memory limit: one number for all data that the process holds at once.

    with memory_limit(1 << 30):
        octree = build_octree(load("chair.npz"))

Code asks before it allocates: a reader before it trusts a size in a file, a stage before it makes its result. The limit
is a context variable, like NumPy's errstate, so that no call can forget to pass it on.

Bytes of data count: files while they are read, what is decoded from them, and results of stages. The interpreter and
its libraries do not count.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TypeVar

from nerfbake.errors import MemoryLimit

DEFAULT = 4 << 30
Counted = TypeVar("Counted")


class _Allowance:
    """Some bytes, those taken for a while, and those of scenes; keeps: scenes count for as long as they live."""

    def __init__(self, limit: int, *, keeps: bool) -> None:
        self.limit, self.keeps = limit, keeps
        self.taken, self.kept, self.scopes = 0, 0, 0

    @property
    def held(self) -> int:
        return self.taken + self.kept

    def let_go(self, size: int) -> None:
        self.kept -= size


# Outside of memory_limit() every call has the whole default for itself: a notebook may hold as many scenes as it likes.
_default = _Allowance(DEFAULT, keeps=False)
_current: ContextVar[_Allowance] = ContextVar("allowance", default=_default)


@contextmanager
def memory_limit(limit: int) -> Iterator[None]:
    """Bounds, in bytes, what everything inside the block holds together.

    >>> from nerfbake import NerfbakeError, memory_limit, sample_n3tree
    >>> with memory_limit(1 << 20):
    ...     try:
    ...         tree = sample_n3tree(resolution=64)
    ...     except NerfbakeError as error:
    ...         print(type(error).__name__)
    MemoryLimit
    """
    token = _current.set(_Allowance(limit, keeps=True))
    try:
        with scope():
            yield
    finally:
        _current.reset(token)


def left() -> int:
    """How many bytes may still be taken."""
    allowance = _current.get()
    return allowance.limit - allowance.held


def require(what: str, size: int) -> None:
    """Raises MemoryLimit if so many bytes do not fit beside what is held already. Takes nothing."""
    allowance = _current.get()
    if allowance.held + size > allowance.limit:
        raise MemoryLimit(what, size, allowance.limit, beside=allowance.held)


def hold(what: str, size: int) -> None:
    """Takes so many bytes until the end of the surrounding scope(), where there is one. Raises MemoryLimit."""
    require(what, size)
    if (allowance := _current.get()).scopes:
        allowance.taken += size


@contextmanager
def lent(what: str, size: int) -> Iterator[None]:
    """Takes so many bytes for as long as the block lasts. Raises MemoryLimit."""
    with scope():
        hold(what, size)
        yield


@contextmanager
def scope() -> Iterator[None]:
    """A block at whose end all that was taken inside it is given back."""
    allowance = _current.get()
    before = allowance.taken
    allowance.scopes += 1
    try:
        yield
    finally:
        allowance.taken = before
        allowance.scopes -= 1


def kept(scene: Counted) -> Counted:
    """The same scene, from now on counted for as long as it lives, inside of memory_limit()."""
    _keep(scene, size_of(scene))
    return scene


def grown(scene: Any, what: str, size: int) -> None:
    """Counts so many bytes more for a scene, for as long as it lives. Raises MemoryLimit if they do not fit."""
    require(what, size)
    _keep(scene, size)


def _keep(scene: Any, size: int) -> None:
    allowance = _current.get()
    if allowance.keeps:
        allowance.kept += size
        weakref.finalize(scene, allowance.let_go, size)


def size_of(scene: Any) -> int:
    """The bytes of all arrays and buffers in a scene, or in a tuple, list or dict of such.

    Of what makes its values when they are asked for, it is what that holds now (`held`), not what they would take.
    """
    match scene:
        case tuple() | list():
            return sum(map(size_of, scene))
        case dict():
            return sum(map(size_of, scene.values()))
        case memoryview():
            return scene.nbytes
        case bytes():
            return len(scene)
    if isinstance(size := getattr(scene, "held", getattr(scene, "nbytes", None)), int):  # of an array: nbytes
        return size
    return sum(map(size_of, vars(scene).values())) if hasattr(scene, "__dataclass_fields__") else 0
