"""`nerfbake batch`: run one command for many scenes, each in its own process, and resume interrupted batches."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import click

from nerfbake import io
from nerfbake.cli.params import (
    ByteSize,
    ParamType,
    as_json,
    bundled,
    console_options,
    is_whole,
    max_memory,
    without_effect,
)
from nerfbake.cli.paths import Reads, StateFolder, Writes, declared
from nerfbake.console import Console
from nerfbake.errors import UsageError

if TYPE_CHECKING:
    from nerfbake.batch.items import CommandLine
    from nerfbake.jobs.batches import BatchOptions, Item


_MOST_SHARDS = 9_999_999


class Shard(ParamType[tuple[int, int]]):
    """i/n: every n-th item, starting with item i, counted from 0."""

    name = "i/n"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        number, slash, count = value.partition("/")
        if not (slash and is_whole(count, 1, _MOST_SHARDS) and is_whole(number, 0, int(count) - 1)):
            self.fail(f"{value!r} is not a shard; allowed: i/n, from 0/n to n-1/n", param, ctx)
        return int(number), int(count)


run_options = bundled(
    "run",
    "jobs.batches.BatchOptions",
    click.option(
        "-j", "--jobs", type=click.IntRange(1, 1024), help="Items that run in parallel.  [default: half the cores]"
    ),
    click.option(
        "--shard", type=Shard(), default=(0, 1), help="Run only every n-th item, starting with item i (from 0)."
    ),
    click.option(
        "--retries",
        type=click.IntRange(0, 100),
        default=0,
        show_default=True,
        help="Number of retries of an item that was killed or could not write its output.",
    ),
    click.option("--fail-fast", is_flag=True, help="Start no more items after one that is not done."),
    click.option("--memory", type=ByteSize(), help="Memory limit for all running items together, by estimate."),
    click.option("--verify", is_flag=True, help="Compare inputs and outputs by their contents, not by size and time."),
    click.option("--take-over", is_flag=True, help="Take over the lock that a batch on another host has left behind."),
)


def _print_snakefile(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    if value:
        from nerfbake.batch.report import snakefile

        io.print_names(str(snakefile()))
        ctx.exit()


@click.command()
@click.argument("template", metavar="[TEMPLATE]", required=False)
@click.argument("inputs", metavar="[INPUTS]...", nargs=-1, type=Reads(readable=False))
@click.option(
    "--jobs-file",
    type=Reads(allow_dash=True),
    help="File with one command line per line, instead of TEMPLATE; '-' for stdin.",
)
@click.option("--state", metavar="DIR", type=StateFolder(), help="Folder that records which items are done.")
@click.option("--plan", is_flag=True, help="Print the command lines and their inputs and outputs; run nothing.")
@run_options
@click.option("--allow-empty", is_flag=True, help="Accept an empty list of items.")
@click.option("--report", type=Writes(), help="Write the results to a .html, .md or .csv file.")
@click.option(
    "--snakefile",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_snakefile,
    help="Print the path of the Snakefile that runs shards, and exit.",
)
@max_memory
@as_json
@console_options
def batch(
    template: str | None,
    inputs: tuple[str, ...],
    jobs_file: str | None,
    state: str | None,
    plan: bool,
    run: BatchOptions,
    allow_empty: bool,
    report: str | None,
    as_json: bool,
    console: Console,
) -> int:
    """Run one command for many files, and resume.

    Runs TEMPLATE for each of INPUTS, or each line of --jobs-file, in its own process. Items that are done are not run
    again.

    In TEMPLATE, {in} is the input, {name} its last path component, {stem} that name without its extension, and {dir}
    its folder. The folder --state records what is done. If you run the same command again, it resumes where it was
    stopped and retries the items that failed. Without TEMPLATE and --jobs-file, it runs nothing and evaluates the items
    of all shards of --state.

    \b
      nerfbake batch 'svo {in} baked/{stem}.svo.pb --min-psnr 30' scenes/*.npz --state run -j 4 --report run/report.html
      nerfbake batch 'svo {in} baked/{stem}.svo.pb' scenes/*.npz --plan > jobs.txt
      nerfbake batch --jobs-file jobs.txt --state run --shard 3/40
      nerfbake batch --state run --report run/report.html

    Exit codes: 0 all items are done, 1 some are not, 3 only qualities were below their limit, 4 the state or the report
    cannot be written.
    """
    from nerfbake.batch.items import fill_template, parse_lines
    from nerfbake.batch.report import load_plan
    from nerfbake.jobs.batches import run_batch

    if template is not None and jobs_file is not None:
        raise UsageError("TEMPLATE and --jobs-file both select the items; allowed: one of them")
    if state is None and not plan:
        raise UsageError("there is no folder for the state; allowed: --state DIR, or --plan")
    named = template is not None or jobs_file is not None
    if plan or not named:
        _refuse_run_options("with --plan" if plan else "without TEMPLATE and --jobs-file", shard=plan)
    if template is not None:
        lines: Iterable[CommandLine] = fill_template(template, inputs)
    elif jobs_file is not None:
        lines = parse_lines(io.load_lines(jobs_file), io.reading_name(jobs_file))
    elif state is not None:
        lines = parse_lines(load_plan(state), f"the plan of {state}")
    else:
        raise UsageError("there is no command to run; allowed: TEMPLATE, or --jobs-file")
    items = list(map(_item, lines))
    if named and not items and not allow_empty:
        raise UsageError("there are no items to run; allowed: INPUTS, or --allow-empty")
    if plan or state is None:
        _print_plan(items, run.shard, as_json=as_json)
        return 0
    print_event = io.print_json if as_json else None
    options = run if named else None
    found = run_batch(items, state=state, run=options, report_to=report, steps=console, report=print_event)
    console.say(found.summary)
    return found.exit_code


def _refuse_run_options(here: str, *, shard: bool) -> None:
    """Raise click.UsageError for options of a run where nothing is run. shard: allow --shard, as --plan does."""
    names = ["jobs", "retries", "fail_fast", "memory", "verify", "take_over", *([] if shard else ["shard"])]
    without_effect(*names, here=here, allowed="TEMPLATE or --jobs-file, without --plan")
    if shard:
        without_effect("state", "report", here=here, allowed="no --plan")


def _item(line: CommandLine) -> Item:
    """The item of a command line, with the paths that its command declares to read and write."""
    from nerfbake.jobs.batches import Item

    group: click.Command = click.get_current_context().find_root().command
    argv = list(line.argv)
    try:
        while isinstance(group, click.Group):
            name = argv.pop(0) if argv else ""
            if name not in group.commands or name == "batch":
                known = ", ".join(sorted(set(group.commands) - {"batch"}))
                raise click.UsageError(f"{name!r} cannot run in a batch; allowed: {known}")
            group = group.commands[name]
        return Item(line.argv, **declared(group, argv)._asdict())
    except click.UsageError as error:
        raise UsageError(f"{line.place}: {error.format_message()}") from None


def _print_plan(items: list[Item], shard: tuple[int, int], *, as_json: bool) -> None:
    from nerfbake.batch.items import require_apart

    require_apart(items)
    for item in items[shard[0] :: shard[1]]:
        if as_json:
            io.print_json(item._asdict())
            continue
        io.print_names(item.line)
        for what, paths in item._asdict().items():
            if what != "argv" and paths:
                io.print_names(f"#   {what}: {', '.join(map(repr, paths))}")
