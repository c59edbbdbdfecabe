"""The list of commands, and the single place that turns exceptions into messages and exit codes."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import traceback
import warnings
from contextlib import suppress
from io import TextIOWrapper
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import click

from nerfbake import __version__
from nerfbake.cli.atlas import atlas
from nerfbake.cli.atlas_error import atlas_error
from nerfbake.cli.batch import batch
from nerfbake.cli.bench import bench
from nerfbake.cli.check import check
from nerfbake.cli.compare import compare
from nerfbake.cli.compress import compress
from nerfbake.cli.convert import convert
from nerfbake.cli.fit import fit
from nerfbake.cli.frames import frames
from nerfbake.cli.hull import hull
from nerfbake.cli.info import info
from nerfbake.cli.lattice import lattice
from nerfbake.cli.lod import lod
from nerfbake.cli.mesh import mesh
from nerfbake.cli.poses import poses
from nerfbake.cli.refit import refit
from nerfbake.cli.render import render
from nerfbake.cli.sample import sample
from nerfbake.cli.shaders import shaders
from nerfbake.cli.ship import ship
from nerfbake.cli.splats import splats
from nerfbake.cli.svo import svo
from nerfbake.cli.vdb import vdb
from nerfbake.cli.view import view
from nerfbake.errors import NerfbakeError, OutputError, PipeClosed, one_line
from nerfbake.io.results import claim_descriptor, report_result

OWN_FAULT = 70  # sysexits.h calls it EX_SOFTWARE
_SUMMARY = 50  # characters of a command's summary: a longer one would be cut at 80 columns
_REPEAT_AFTER = 0.01  # seconds: by then the finalizer that dropped a signal has returned
_PR_SET_PDEATHSIG = 1  # linux/prctl.h
# malloc.h of the GNU C library: the free bytes at the end of its heap, and of a block, from which it returns them.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = (-1, 16 << 20), (-3, 8 << 20)


GROUPS = {
    "Create": (frames, poses, fit, refit, sample),
    "Convert": (svo, vdb, lattice, splats, mesh, atlas, convert, compress, lod, hull, ship, shaders),
    "View": (view, render, info),
    "Measure": (compare, check, atlas_error, bench),
    "Batch": (batch,),
}


class LeakedEndOfFile(Exception):
    """An EOFError that a command did not expect. Click would turn it into Abort, as it does Ctrl-C."""

    def __init__(self, fault: EOFError) -> None:
        self.fault = fault


class GroupedCommands(click.Group):
    """A click group whose help lists the commands under the headings of GROUPS."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except EOFError as error:
            raise LeakedEndOfFile(error) from None

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        width = max(map(len, self.commands))
        for title, commands in GROUPS.items():
            rows = [(f"{command.name:{width}}", command.get_short_help_str(_SUMMARY + 1)) for command in commands]
            with formatter.section(title):
                formatter.write_dl(rows)


@click.group(cls=GroupedCommands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="nerfbake")
def cli() -> None:
    """Turn photographs, radiance fields and splats into octrees, volumes, meshes, splats, web pages and shaders.

    The file extension selects the format. Use '-' for stdin or stdout. Data go to stdout, messages to stderr.

    \b
      nerfbake fit photographs chair.npz
      nerfbake svo chair.npz chair.svo.pb --resolution 128
      nerfbake atlas mesh_stage1 chair_atlas --clusters 256
      nerfbake vdb chair.npz chair.vdb
      nerfbake svo chair.npz - --to svo.pb | nerfbake info - --json

    Run 'nerfbake COMMAND --help' for the options of a command.

    Exit codes: 0 success, 1 bad input, 2 wrong usage, 3 quality below the limit, 4 output cannot be written,
    70 bug in nerfbake.
    """


for commands in GROUPS.values():
    for command in commands:
        cli.add_command(command)


def main() -> NoReturn:
    """Run the command line and exit."""
    _reserve_standard_streams()
    _give_memory_back()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # file names may not fit the terminal's encoding
    if not sys.warnoptions:
        warnings.simplefilter("ignore")  # they are for developers: `python -W error -m nerfbake` shows them
    signal.signal(signal.SIGTERM, _stop)
    sys.unraisablehook = _repeat_signal
    claim_descriptor()
    _exit_with_batch(os.environ.pop("NERFBAKE_BATCH", ""))
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """Run a command line and return its exit code. Every exception is caught here and printed as one line."""
    try:
        result = cli.main(arguments, prog_name="nerfbake", standalone_mode=False)
        return result if isinstance(result, int) else 0
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message(), err=True)
        return error.exit_code
    except click.UsageError as error:
        command = error.ctx.command_path if error.ctx else "nerfbake"
        return _fail(f"{error.format_message()} (see '{command} --help')", error.exit_code)
    except click.ClickException as error:
        return _fail(error.format_message(), error.exit_code)
    except PipeClosed as error:
        # The interpreter flushes stdout at exit: redirect it, since the pipe is closed.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return error.exit_code
    except SystemExit as error:
        if error.code == 1:  # click exits with 1 if the pipe is closed while it prints --help
            return PipeClosed.exit_code
        raise
    except NerfbakeError as error:
        return _fail(error.line, error.exit_code)
    except MemoryError:
        return _fail("out of memory; a lower --resolution or --max-memory may help", 1)
    except (click.Abort, KeyboardInterrupt):
        return _fail("stopped", 128 + signal.SIGINT)
    except OSError as error:
        return _fail(error.strerror or str(error), OutputError.exit_code)
    except Exception as caught:
        fault = caught.fault if isinstance(caught, LeakedEndOfFile) else caught
        if os.environ.get("NERFBAKE_TRACEBACK"):
            raise fault from fault.__cause__
        return _fail(f"{_describe_bug(fault)}; please report it (NERFBAKE_TRACEBACK=1 shows more)", OWN_FAULT)


def _describe_bug(error: Exception) -> str:
    """Return the description of a bug in nerfbake: exception type, file, line and message."""
    place = [frame for frame in traceback.extract_tb(error.__traceback__) if "nerfbake" in frame.filename][-1]
    return f"a bug in nerfbake: {type(error).__name__} in {Path(place.filename).name}:{place.lineno}, {error}"


def _fail(text: str, code: int) -> int:
    text = one_line(text)
    report_result(error=text)
    with suppress(OSError):  # a full or closed stderr: the exit code remains
        click.echo(f"error: {text}", err=True)
    return code


def _reserve_standard_streams() -> None:
    """Open /dev/null for each closed standard stream: otherwise the next opened file would get its descriptor."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free descriptor


def _give_memory_back() -> None:
    """With the GNU C library: return the memory of large arrays when they are freed.

    By default, the library keeps up to 64 MiB of it once it has freed such arrays, beyond --max-memory.
    """
    if sys.platform == "linux":
        with suppress(AttributeError):  # musl has no such function
            for option, size in (_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD):
                ctypes.CDLL(None).mallopt(option, size)


def _exit_with_batch(batch: str) -> None:
    """On Linux: receive SIGTERM when the batch that started this process (its process id) exits for any reason."""
    if batch and sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if str(os.getppid()) != batch:  # it exited before the prctl() call
            sys.exit(128 + signal.SIGTERM)


def _stop(number: int, frame: FrameType | None) -> NoReturn:
    """Handle SIGTERM: exit through the cleanup code, which removes temporary files."""
    sys.exit(128 + number)


def _repeat_signal(dropped: sys.UnraisableHookArgs) -> None:
    """Raise a signal again whose exception a finalizer has dropped: Python ignores what finalizers raise."""
    signals = {KeyboardInterrupt: signal.SIGINT, SystemExit: signal.SIGTERM}
    if dropped.exc_type not in signals:
        sys.__unraisablehook__(dropped)
        return
    threading.Timer(_REPEAT_AFTER, os.kill, [os.getpid(), signals[dropped.exc_type]]).start()
