"""Files cut off and with flipped bits: read or refused; by commands in one line, soon, in little memory."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from nerfbake import build_octree, build_vdb, catalog, save
from nerfbake.errors import NerfbakeError
from nerfbake.formats.splat import sog_folder
from tests.conftest import REPOSITORY
from tests.fuzz import corpus
from tests.support.hostile import damaged
from tests.support.n3trees import archive, svox
from tests.support.octrees import SPELLINGS
from tests.support.scenes import n3tree
from tests.support.vdb_readers import blosc_for_zip, bloscked

DAMAGED: list[tuple[str, str, str | None]] = [("svo", "npz", None), ("svo", "stored.npz", None)]
DAMAGED += [("convert", name, profile) for name, profile in SPELLINGS]
DAMAGED += [("convert", "svo.pb.zst", "report"), ("convert", "svo.npz.zst", None)]
DAMAGED += [("convert", suffix, None) for suffix in ("vdb", "nvdb", "zip.nvdb", "vdb.npz", "blosc.vdb", "blosc.nvdb")]


def good_file(command: str, suffix: str, profile: str | None, folder: Path) -> Path:
    tree = n3tree(splits=[(0, (0, 0, 0)), (0, (1, 0, 1)), (1, (1, 1, 1))], data_format="SH4")
    source = folder / f"good.{suffix}"
    if command == "svo":
        source.write_bytes(archive(svox(tree), deflated=suffix == "npz"))
    elif "vdb" in suffix:
        grids = ("index",) if "nvdb" in suffix else ("density", "sh")
        codec: Any = {"codec": "zip"} if suffix == "zip.nvdb" else {}
        with blosc_for_zip() if suffix == "blosc.vdb" else nullcontext():
            save(source, build_vdb(build_octree(tree), grids=grids), **codec)
        if suffix == "blosc.nvdb":
            source.write_bytes(bloscked(source.read_bytes()))
    else:
        options: Any = {"profile": profile} if profile else {}
        save(source, build_octree(tree), **options)
    return source


class Tried(NamedTuple):
    sources: list[Path]
    findings: list[str]  # a line of JSON for each source
    stderr: str


@pytest.fixture(scope="module")
def tried(tmp_path_factory: pytest.TempPathFactory) -> Tried:
    """All files, by one process: to start one for each would take longer than to try it."""
    sources = [good_file(*case, tmp_path_factory.mktemp("damaged")) for case in DAMAGED]
    jobs = [part for case, source in zip(DAMAGED, sources, strict=True) for part in (case[0], str(source))]
    line = [sys.executable, "-m", "tests.support.hostile", "120", *jobs]
    done = subprocess.run(line, cwd=REPOSITORY, capture_output=True, text=True, timeout=600, check=False)
    return Tried(sources, done.stdout.splitlines(), done.stderr)


@pytest.mark.long
@pytest.mark.parametrize("number", range(len(DAMAGED)), ids=["-".join(map(str, case)) for case in DAMAGED])
def test_damaged_files(number: int, tried: Tried) -> None:
    """Cut at every 1 %, and 120 bit flips: exit 0 or 1, one line, under 5 s, under 3 GiB, nothing left behind."""
    assert len(tried.findings) > number, tried.stderr  # the process ended early
    assert json.loads(tried.findings[number]) == []
    source = tried.sources[number]
    assert sorted(path.name for path in source.parent.iterdir()) == [source.name.replace("good", "bad"), source.name]


# Formats that no command above reads: their decoder alone. Stages of USD have a test of their own, beside their reader.
DECODED = {
    form.name
    for form in catalog.FORMATS
    if form.readable and form.scene not in ("SparseVoxelOctree", "Volume") and not form.library
}


@pytest.mark.parametrize("name", sorted(DECODED))
def test_a_damaged_scene_is_read_or_refused(name: str) -> None:
    sounds, refused = corpus.files_of(name), 0
    for form in catalog.FORMATS:
        for sound in sounds if form.name == name else ():
            for _, broken in damaged(sound, flips=300 // len(sounds)):
                try:
                    form.load_module().decode(memoryview(broken or b"\0"))  # io refuses empty files
                except NerfbakeError:
                    refused += 1
    assert refused > 50


def test_a_damaged_file_of_a_sog_is_read_or_refused() -> None:
    """As a folder: in the archive, checksums would detect most damage before any other check."""
    for scene in corpus.folders_of("sog_folder")[:2]:
        views = {name: memoryview(data) for name, data in scene.items()}
        for name in scene:
            for _, broken in damaged(scene[name], flips=10):
                with suppress(NerfbakeError):
                    sog_folder.decode({**views, name: memoryview(broken)})
