"""Run the command line in forks of a process that has already imported Python, NumPy and Numba.

For small scenes, starting Python, NumPy and Numba takes longer than most commands, and the tests run hundreds of
commands. Everything else is as in `python -m nerfbake`: arguments, working directory, environment, streams, signals and
exit code.
"""

from __future__ import annotations

import atexit
import gc
import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from tests.support.compression import obey_switch

PATIENCE = 300  # seconds
_ROOM = 1 << 20  # maximum bytes of a request
_STREAMS = (0, 1, 2)


class Forks:
    """Runs commands one after another, each in a fork of a server process, with the current environment."""

    def __init__(self, folder: Path) -> None:
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(PATIENCE)
        command = [sys.executable, "-m", "tests.support.forks", str(theirs.fileno())]
        nowhere: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
        self._server = subprocess.Popen(command, cwd=folder, pass_fds=[theirs.fileno()], **nowhere)
        theirs.close()

    def run(self, arguments: tuple[str, ...], folder: Path, stdin: bytes) -> subprocess.CompletedProcess[bytes]:
        with TemporaryFile() as given, TemporaryFile() as out, TemporaryFile() as err:
            given.write(stdin)
            given.seek(0)
            request = json.dumps([arguments, str(folder), dict(os.environ)]).encode()
            socket.send_fds(self._socket, [request], [given.fileno(), out.fileno(), err.fileno()])
            code = int(self._socket.recv(_ROOM))
            out.seek(0)
            err.seek(0)
            return subprocess.CompletedProcess(["nerfbake", *arguments], code, out.read(), err.read())

    def close(self) -> None:
        self._socket.close()
        self._server.wait(PATIENCE)


def _become_a_command(connection: socket.socket) -> bool:
    """Wait for requests and fork for each. Returns True in a fork, and False in the server after the last request."""
    while True:
        request, streams, _, _ = socket.recv_fds(connection, _ROOM, len(_STREAMS))
        if not request:
            return False
        if (child := os.fork()) == 0:
            connection.close()
            arguments, folder, environment = json.loads(request)
            os.chdir(folder)
            os.environ.clear()
            os.environ.update(environment)
            sys.argv[1:] = arguments
            for stream, number in zip(streams, _STREAMS, strict=True):
                os.dup2(stream, number)
                os.close(stream)
            return True
        for stream in streams:
            os.close(stream)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        connection.send(str(code).encode())


if __name__ == "__main__":
    import numba

    from nerfbake.cli.main import main

    first: Any = numba.njit(lambda: 0)
    first()  # makes Numba import its modules for the first kernel; it starts no threads
    gc.freeze()
    if _become_a_command(socket.socket(fileno=int(sys.argv[1]))):
        obey_switch()
        try:
            main()
        except SystemExit as end:
            atexit._run_exitfuncs()
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(int(end.code or 0))  # freeing all imported modules would take longer than most commands
