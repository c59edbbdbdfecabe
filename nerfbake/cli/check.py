"""`nerfbake check`: what is wrong with a file."""

from __future__ import annotations

import click

from nerfbake import io
from nerfbake.cli.params import as_json, reads, speaks
from nerfbake.cli.words import Words
from nerfbake.errors import for_shell
from nerfbake.jobs.files import Source


@click.command()
@reads
@as_json
@speaks
def check(source: Source, as_json: bool, words: Words) -> int:
    """Check a file for errors.

    Prints everything that is wrong with IN, one line each. The exit code is 1 if anything is.

    \b
      nerfbake check chair.npz && nerfbake svo chair.npz chair.svo.pb
    """
    with words.phase(f"checking {source.path}"):
        problems = io.check(source.path)
    if as_json:
        found = [{**problem._asdict(), "message": str(problem)} for problem in problems]
        io.print_json({"file": source.path, "ok": not problems, "problems": found})
    else:
        for problem in problems:
            io.print_text(f"{source.path}: {for_shell(problem.line)}")
        if not problems:
            words.say(f"{source.path}: ok")
    return 1 if problems else 0
