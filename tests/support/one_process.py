"""Run the commands of shell scripts in one process, one after another: kernels are loaded once for all of them.

For small scenes, a new process loads modules and compiled kernels for longer than most commands take. A script finds a
`nerfbake` on its path that sends its arguments, working directory and streams, and exits with the command's code. The
commands of a pipe run at the same time, in forks.
"""

from __future__ import annotations

import os
import shutil
import socket
import stat
import subprocess
import sys
from pathlib import Path
from tempfile import mkdtemp

_ROOM = 1 << 16  # maximum bytes of a request
_STREAMS = (0, 1, 2)
_CLIENT = """#!{python} -IS
import os, socket, sys
with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as server:
    server.connect({address!r})
    socket.send_fds(server, ["\\0".join([os.getcwd(), *sys.argv[1:]]).encode()], [0, 1, 2])
    sys.exit(int(server.recv(16) or b"1"))
"""


class OneProcess:
    """The process. `path`: the folder of the `nerfbake` that sends commands to it."""

    def __init__(self, repository: Path) -> None:
        self.path = Path(mkdtemp())
        address = str(self.path / "socket")
        client = self.path / "nerfbake"
        client.write_text(_CLIENT.format(python=sys.executable, address=address))
        client.chmod(0o755)
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
            listener.bind(address)
            listener.listen()
            command = [sys.executable, "-m", "tests.support.one_process", str(listener.fileno())]
            self._server = subprocess.Popen(command, cwd=repository, pass_fds=[listener.fileno()])

    def close(self) -> None:
        self._server.terminate()
        self._server.wait()
        shutil.rmtree(self.path)


def _serve(listener: socket.socket) -> None:
    while True:
        connection, _ = listener.accept()
        request, streams, _, _ = socket.recv_fds(connection, _ROOM, len(_STREAMS))
        piped = any(stat.S_ISFIFO(os.fstat(stream).st_mode) for stream in streams[:2])
        if not piped or os.fork() == 0:
            folder, *arguments = request.decode().split("\0")
            for stream, number in zip(streams, _STREAMS, strict=True):
                os.dup2(stream, number)
            connection.send(str(_code_of(arguments, folder)).encode())
            if piped:
                os._exit(0)
        for stream in streams:
            os.close(stream)
        connection.close()


def _code_of(arguments: list[str], folder: str) -> int:
    """Run a command and return its exit code."""
    from nerfbake.cli.main import main

    os.chdir(folder)
    sys.argv[1:] = arguments
    with (
        open(0, closefd=False) as sys.stdin,
        open(1, "w", closefd=False) as sys.stdout,
        open(2, "w", 1, closefd=False) as sys.stderr,
    ):
        try:
            main()
        except SystemExit as end:
            return int(end.code or 0)


if __name__ == "__main__":
    _serve(socket.socket(fileno=int(sys.argv[1])))
