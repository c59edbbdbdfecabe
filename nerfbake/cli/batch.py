"""`nerfbake batch`: many scenes, one process each, and a state that goes on where it was stopped."""

from __future__ import annotations

from collections.abc import Iterable
from functools import wraps
from typing import TYPE_CHECKING, Any

import click

from nerfbake import io
from nerfbake.cli.params import Command, Size, as_json, max_memory, speaks, without_effect
from nerfbake.cli.paths import Keeps, Reads, Writes, declared
from nerfbake.cli.words import Words
from nerfbake.errors import UsageError

if TYPE_CHECKING:
    from nerfbake.batch.lines import Line
    from nerfbake.jobs.batches import Item


class Shard(click.ParamType[tuple[int, int]]):
    """i/n: every n-th item from i, counted from 0."""

    name = "i/n"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        number, slash, count = value.partition("/")
        if not (slash and number.isdecimal() and count.isdecimal() and len(count) < 8 and int(number) < int(count)):
            self.fail(f"{value!r} is no shard; allowed: i/n, 0/n to n-1/n", param, ctx)
        return int(number), int(count)


def runs(function: Command) -> Command:
    """Adds -j, --shard, --retries, --fail-fast, --memory, --verify and --take-over; the command gets `run`, a dict."""

    @click.option(
        "-j", "--jobs", type=click.IntRange(1, 1024), help="Items beside each other.  [default: half the cores]"
    )
    @click.option("--shard", type=Shard(), help="Only every n-th item from i, counted from 0: for array jobs.")
    @click.option(
        "--retries",
        type=click.IntRange(0, 100),
        default=0,
        show_default=True,
        help="Try so often again what was killed, or could not write its output.",
    )
    @click.option("--fail-fast", is_flag=True, help="Start no more items once one is not done.")
    @click.option("--memory", type=Size(), help="What all running items may take together, as far as that is known.")
    @click.option("--verify", is_flag=True, help="Read inputs and outputs, whatever their sizes and times say.")
    @click.option("--take-over", is_flag=True, help="Take over the lock that a batch on another host left behind.")
    @wraps(function)
    def command(*args: Any, shard: tuple[int, int] | None, **others: Any) -> Any:
        names = ("jobs", "retries", "fail_fast", "memory", "verify", "take_over")
        run = {name: others.pop(name) for name in names}
        return function(*args, run={**run, "shard": shard or (0, 1)}, **others)

    return command


def _print_snakefile(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    if value:
        from nerfbake.batch.files import snakefile

        io.print_names(str(snakefile()))
        ctx.exit()


@click.command()
@click.argument("template", metavar="[TEMPLATE]", required=False)
@click.argument("inputs", metavar="[INPUTS]...", nargs=-1, type=Reads(readable=False))
@click.option(
    "--jobs-file", type=Reads(allow_dash=True), help="A file with a command line a line, instead of TEMPLATE; or '-'."
)
@click.option("--state", metavar="DIR", type=Keeps(), help="The folder that knows what is done.")
@click.option("--plan", is_flag=True, help="Print the lines, and what each reads and writes; run nothing.")
@runs
@click.option("--allow-empty", is_flag=True, help="No INPUTS are no mistake.")
@click.option("--report", type=Writes(), help="Write what came of it as .html, .md or .csv.")
@click.option(
    "--snakefile",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_snakefile,
    help="Print where the Snakefile is that runs shards, and exit.",
)
@max_memory
@as_json
@speaks
def batch(
    template: str | None,
    inputs: tuple[str, ...],
    jobs_file: str | None,
    state: str | None,
    plan: bool,
    run: dict[str, Any],
    allow_empty: bool,
    report: str | None,
    as_json: bool,
    words: Words,
) -> int:
    """Run a command for many files, and resume.

    Runs TEMPLATE for each of INPUTS, or each line of --jobs-file, in a process of its own, and none twice.

    In TEMPLATE {in} is the input, {name} its last part, {stem} this without its ending, {dir} the folder it is in. What
    is done stands in the folder --state: the same command goes on where it was stopped, and tries again what failed.
    Without TEMPLATE and --jobs-file nothing is run, and what all shards of --state have done is judged.

    \b
      nerfbake batch 'svo {in} baked/{stem}.svo.pb --min-psnr 30' scenes/*.npz --state run -j 4 --report run/report.html
      nerfbake batch 'svo {in} baked/{stem}.svo.pb' scenes/*.npz --plan > jobs.txt
      nerfbake batch --jobs-file jobs.txt --state run --shard 3/40
      nerfbake batch --state run --report run/report.html

    Exit codes: 0 all are done, 1 some are not, 3 only quality budgets were missed, 4 the state or the report cannot be
    written.
    """
    from nerfbake.batch.files import load_plan
    from nerfbake.batch.lines import fill_template, parse_lines
    from nerfbake.jobs.batches import Run, run_batch

    if template is not None and jobs_file is not None:
        raise UsageError("TEMPLATE and --jobs-file each say what to run; allowed: one of them")
    if state is None and not plan:
        raise UsageError("nothing says where to keep what is done; allowed: --state DIR, or --plan")
    named = template is not None or jobs_file is not None
    if plan or not named:
        _refuse_options_of_runs("with --plan" if plan else "where nothing is run", shard=plan)
    if template is not None:
        lines: Iterable[Line] = fill_template(template, inputs)
    elif jobs_file is not None:
        lines = parse_lines(io.load_lines(jobs_file), io.reading_name(jobs_file))
    elif state is not None:
        lines = parse_lines(load_plan(state), f"the plan of {state}")
    else:
        raise UsageError("nothing says what to run; allowed: TEMPLATE, or --jobs-file")
    items = list(map(_item, lines))
    if named and not items and not allow_empty:
        raise UsageError("there is nothing to run; allowed: INPUTS, or --allow-empty")
    if plan or state is None:
        _print_plan(items, run["shard"], as_json=as_json)
        return 0
    tell = io.print_json if as_json else None
    how = Run(**run) if named else None
    found = run_batch(items, state=state, run=how, report_to=report, steps=words, report=tell)
    words.say(found.told)
    return found.exit_code


def _refuse_options_of_runs(here: str, *, shard: bool) -> None:
    names = ["jobs", "retries", "fail_fast", "memory", "verify", "take_over", *([] if shard else ["shard"])]
    without_effect(*names, here=here, allowed="it where items are run")
    if shard:
        without_effect("state", "report", here=here, allowed="it without --plan")


def _item(line: Line) -> Item:
    """The line, with what its command says that it reads and writes."""
    from nerfbake.jobs.batches import Item

    group: click.Command = click.get_current_context().find_root().command
    words = list(line.argv)
    try:
        while isinstance(group, click.Group):
            name = words.pop(0) if words else ""
            if name not in group.commands or name == "batch":
                known = ", ".join(sorted(set(group.commands) - {"batch"}))
                raise click.UsageError(f"{name!r} is no command of a batch; allowed: {known}")
            group = group.commands[name]
        return Item(line.argv, **declared(group, words)._asdict())
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
