"""`python -m nerfbake`, and the `nerfbake` command."""

from __future__ import annotations

import os
import sys
from typing import NoReturn


def main() -> NoReturn:
    """Runs the command line and exits; Ctrl-C while its modules are imported ends it in one line, too."""
    try:
        from nerfbake.cli.main import main as run
    except KeyboardInterrupt:
        os.write(2, b"error: stopped\n")
        sys.exit(130)
    run()


if __name__ == "__main__":
    main()
