"""Answer requests as the child of nerfbake.formats.wire.usd.reading does, each in a fork, without loading OpenUSD anew.

stdin: requests, each after the answer to the one before. stdout: JSON [exit code, bytes] and a line feed | the answer.
"""

from __future__ import annotations

import json
import os
import select
import sys
import tempfile

from pxr import Usd, UsdGeom, UsdShade

from nerfbake.formats.wire.usd import _child

LOADED = (Usd, UsdGeom, UsdShade)


def main() -> None:
    poll = select.poll()
    poll.register(0, select.POLLIN)
    while poll.poll()[0][1] & select.POLLIN:  # without it, the other end is closed
        with tempfile.TemporaryDirectory() as folder:
            out, into = os.pipe()
            if (child := os.fork()) == 0:
                os.dup2(into, 1)
                os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
                os.close(out)
                os.chdir(folder)
                sys.stdin = os.fdopen(os.dup(0), "r")
                sys.stdout = os.fdopen(os.dup(1), "w")
                try:
                    _child.main()
                finally:
                    os._exit(1)
            os.close(into)
            with os.fdopen(out, "rb") as answer:
                data = answer.read()
            code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        sys.stdout.buffer.write(json.dumps([code, len(data)]).encode() + b"\n" + data)
        sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
