"""`nerfbake check`: list the errors of a file."""

from __future__ import annotations

import click

from nerfbake import io
from nerfbake.cli.params import as_json, console_options, source_argument
from nerfbake.console import Console
from nerfbake.errors import for_shell, one_line
from nerfbake.jobs.files import Source


@click.command()
@source_argument
@as_json
@console_options
def check(source: Source, as_json: bool, console: Console) -> int:
    """Check a file for errors.

    Prints one line for each error in IN. Exits with code 1 if there are any.

    \b
      nerfbake check chair.npz && nerfbake svo chair.npz chair.svo.pb
    """
    with console.phase(f"checking {source.path}"):
        problems = io.check(source.path)
    if as_json:
        found = [{**problem._asdict(), "message": str(problem)} for problem in problems]
        io.print_json({"file": source.path, "ok": not problems, "problems": found})
    else:
        for problem in problems:
            io.print_text(f"{one_line(source.path)}: {for_shell(problem.line)}")
        if not problems:
            console.say(f"{source.path}: ok")
    return 1 if problems else 0
