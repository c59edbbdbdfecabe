"""A command that reads OUT back refuses a pipe or a device before the work: it would wait for ever."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from nerfbake.cli.main import run

# Nothing of what they name exists: these errors come before anything is read.
MEASURED = {
    "mesh a.npz {out}": ".glb",
    "mesh a.npz {out} --force": ".obj",
    "splats a.npz {out}": ".spz",
    "fit photographs {out}": ".npz",
    "refit a.svo.pb {out} --like b.npz": ".svo.pb",
    "svo a.npz {out} --min-psnr 10": ".svo.pb",
    "lod a.svo.pb {out} --level 2 --min-psnr 10": ".svo.pb",
    "vdb a.npz {out} --min-psnr 10 --force": ".vdb",
    "compress a.npz {out} --min-psnr 10": ".svoq",
    "view a.npz {out} --min-psnr 10": ".html",
}


@pytest.mark.parametrize("line", MEASURED)
def test_a_pipe_is_refused_before_the_work(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    ending = MEASURED[line]
    os.mkfifo(f"pipe{ending}")
    Path(f"link{ending}").symlink_to(f"pipe{ending}")
    Path(f"null{ending}").symlink_to(os.devnull)
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(f"socket{ending}")
        for out in ("pipe", "link", "null", "socket"):
            assert run(line.format(out=out + ending).split()) == 2
            message = capsys.readouterr().err
            assert f"{out}{ending} is a pipe or a device, but " in message
            assert message.endswith("; allowed: a regular file\n")


def test_a_pipe_in_place_of_a_folder_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo(tmp_path / "pipe")
    for command in ("mesh a.npz", "lattice a.npz", "atlas stage1", "shaders", "sample nerf2mesh"):
        for force in ([], ["--force"]):
            assert run([*command.split(), str(tmp_path / "pipe"), *force]) == 4
            assert capsys.readouterr().err.endswith("/pipe: is not a folder; allowed: a new folder\n")
