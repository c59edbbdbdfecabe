"""The cache of compiled kernels: damaged files, full disks and a second process never stop a command."""

from __future__ import annotations

import errno
import importlib.util
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from nerfbake.kernels import compile_times
from nerfbake.kernels.kernel_cache import KernelCacheFile

CODE = """
from nerfbake.kernels.jit import compiled
@compiled()
def twice(x):
    return x * 2
"""
Load = Callable[[], Any]


@pytest.fixture
def load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Load:
    """Import a module with a kernel, as a new process would. Its cache is in tmp_path/cache."""
    (tmp_path / "kernel.py").write_text(CODE)
    # In both places: numba reads the environment anew when it compiles after any of its variables has changed.
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(compile_times, "uncached", [])

    def load() -> Any:
        spec = importlib.util.spec_from_file_location("kernel", tmp_path / "kernel.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module.twice

    return load


def hits(kernel: Any) -> int:
    return sum(kernel.stats.cache_hits.values())


def files(tmp_path: Path, ending: str) -> list[Path]:
    return sorted((tmp_path / "cache").rglob(f"*{ending}"))


def flip(content: bytes) -> bytes:
    """Change one bit in the middle."""
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda content: b"",
    "random": lambda content: np.random.default_rng(0).bytes(300),
    "zeros": lambda content: bytes(len(content)),  # after a power loss
    "short": lambda content: content[: len(content) // 2],
    "flipped": flip,
    "no pickle": lambda content: b"\x80\x05.",
    "of numba": lambda content: content[32:],  # without our hash
}


@pytest.mark.parametrize("ending", [".nbi", ".nbc"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_cache_is_compiled_anew_and_replaced(ending: str, damage: str, load: Load, tmp_path: Path) -> None:
    assert load()(3.0) == 6.0
    again = load()
    assert again(3.0) == 6.0
    assert hits(again) == 1
    (path,) = files(tmp_path, ending)
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    damaged = load()
    assert damaged(3.0) == 6.0
    assert hits(damaged) == 0
    mended = load()
    assert mended(3.0) == 6.0
    assert hits(mended) == 1
    assert compile_times.uncached == []


def test_a_folder_in_place_of_a_file_is_no_obstacle(load: Load, tmp_path: Path) -> None:
    load()(3.0)
    (path,) = files(tmp_path, ".nbi")
    path.unlink()
    path.mkdir()
    assert load()(3.0) == 6.0
    assert compile_times.uncached == ["twice"]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EIO])
@pytest.mark.parametrize("step", ["_open_for_write", "ensure_cache_path"])
def test_a_cache_that_cannot_be_written_leaves_the_kernel_in_memory(
    number: int, step: str, load: Load, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: object) -> None:
        raise OSError(number, os.strerror(number))

    kernel = load()
    owner = KernelCacheFile if step == "_open_for_write" else type(kernel._cache._impl.locator)
    monkeypatch.setattr(owner, step, fail)
    assert kernel(3.0) == 6.0
    assert kernel(3) == 6
    assert compile_times.uncached == ["twice", "twice"]
    assert not [path for path in files(tmp_path, "") if path.is_file()]


def test_two_processes_that_write_a_file_of_the_same_name_do_not_read_that_of_the_other(
    load: Load, tmp_path: Path
) -> None:
    """Both find an empty index and take the first name: the data of one stand beside the index of the other."""
    load()(3.0)
    ((index, content),) = [(path, path.read_bytes()) for path in files(tmp_path, ".nbi")]
    index.unlink()
    load()(3)
    index.write_bytes(content)  # of the floating-point kernel; the data are those of the integer kernel
    kernel = load()
    assert kernel(1.5) == 3.0
    assert hits(kernel) == 0
