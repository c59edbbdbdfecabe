"""The memory limit: one upper bound for all data that the process holds at once.

    with memory_limit(1 << 30):
        octree = build_octree(load("chair.npz"))

Check the limit before each allocation: a reader before it uses a size from a file, a stage before it creates its
result. The limit is a context variable, like NumPy's errstate, so that no call can skip the check.

The limit counts bytes of data: files while they are read, the arrays decoded from them, and the results of stages. It
does not count the interpreter and its libraries.
"""

from __future__ import annotations

import ctypes
import sys
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import Any, TypeVar

from nerfbake.errors import MemoryLimit

DEFAULT = 4 << 30
Counted = TypeVar("Counted")


class _Allowance:
    """A limit with the bytes taken temporarily and the bytes of scenes. keeps: count scenes while they exist."""

    def __init__(self, limit: int, *, keeps: bool) -> None:
        self.limit, self.keeps = limit, keeps
        self.taken, self.kept = 0, 0

    @property
    def held(self) -> int:
        return self.taken + self.kept

    def let_go(self, size: int) -> None:
        with _counting:
            self.kept -= size


class _Scope:
    """The bytes taken in a scope."""

    taken = 0


_counting = threading.RLock()  # the garbage collector may let go while this thread counts
# Outside memory_limit() each call has the whole default limit for itself: a notebook may keep any number of scenes.
_default = _Allowance(DEFAULT, keeps=False)
_current: ContextVar[_Allowance] = ContextVar("allowance", default=_default)
_scope: ContextVar[_Scope | None] = ContextVar("scope", default=None)


@contextmanager
def memory_limit(limit: int) -> Iterator[None]:
    """Limit the bytes of all data inside the block together.

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
    """The number of bytes that can still be taken."""
    allowance = _current.get()
    return allowance.limit - allowance.held


def require(what: str, size: int) -> None:
    """Raise MemoryLimit if `size` bytes do not fit in addition to those in use. Takes nothing."""
    allowance = _current.get()
    if allowance.held + size > allowance.limit:
        raise MemoryLimit(what, size, allowance.limit, beside=allowance.held)


def hold(what: str, size: int) -> None:
    """Take `size` bytes until the end of the surrounding scope(), if there is one. Raises MemoryLimit."""
    with _counting:
        require(what, size)
        if (own := _scope.get()) is not None:
            own.taken += size
            _current.get().taken += size


@contextmanager
def lent(what: str, size: int) -> Iterator[None]:
    """Take `size` bytes for the duration of the block. Raises MemoryLimit."""
    with scope():
        hold(what, size)
        yield


@contextmanager
def scope() -> Iterator[None]:
    """Give back all bytes taken inside the block when it ends."""
    allowance, own, outer = _current.get(), _Scope(), _scope.get()
    _scope.set(own)
    try:
        yield
    finally:
        _scope.set(outer)  # not reset(): a generator may end in another context
        with _counting:
            allowance.taken -= own.taken


def kept(scene: Counted) -> Counted:
    """Return the scene, counted as long as it exists if inside memory_limit()."""
    _keep(scene, size_of(scene))
    return scene


def grown(scene: Any, what: str, size: int) -> None:
    """Count `size` more bytes for a scene as long as it exists. Raises MemoryLimit if they do not fit.

    Outside memory_limit() they count until the end of the surrounding scope().
    """
    if _current.get().keeps:
        require(what, size)
        _keep(scene, size)
    else:
        hold(what, size)


def _keep(scene: Any, size: int) -> None:
    allowance = _current.get()
    if allowance.keeps:
        with _counting:
            allowance.kept += size
        weakref.finalize(scene, allowance.let_go, size)


def give_back() -> None:
    """Return freed memory to the system: the GNU C library keeps that of small arrays, as of hundreds of pictures."""
    if sys.platform == "linux":
        with suppress(AttributeError):  # musl has no such function
            ctypes.CDLL(None).malloc_trim(0)


def size_of(scene: Any) -> int:
    """The bytes of all arrays and buffers in a scene, or in a tuple, list or dict of scenes.

    For an object that computes its values on demand, only the bytes that it currently holds (`held`) count.
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
    if isinstance(size := getattr(scene, "held", getattr(scene, "nbytes", None)), int):  # nbytes: an array
        return size
    return sum(map(size_of, vars(scene).values())) if hasattr(scene, "__dataclass_fields__") else 0
