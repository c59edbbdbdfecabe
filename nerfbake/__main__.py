"""Entry point of `python -m nerfbake` and of the `nerfbake` command."""

from __future__ import annotations

import os
import sys
from typing import NoReturn


def main() -> NoReturn:
    """Run the command line and exit. Ctrl-C during the imports and the preparations also ends with one line."""
    try:
        from nerfbake.cli.main import main as run

        run()
    except KeyboardInterrupt:
        os.write(2, b"error: stopped\n")
        sys.exit(130)


if __name__ == "__main__":
    main()
