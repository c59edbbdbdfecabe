"""Class names are unique, stages start with a verb, summaries in the help and modules are short."""

from __future__ import annotations

import ast
from collections import Counter

from nerfbake.cli.main import cli
from tests.support.source import PACKAGE, modules, parsed, public_names_of

LONGEST_MODULE = 500  # lines
LONGEST_SUMMARY = 50  # characters
VERBS = {"bake", "build", "carve", "cast", "cluster", "compare", "compress", "cut", "fill", "fit", "identify", "lower"}
VERBS |= {
    "colour",
    "measure",
    "merge",
    "move",
    "orbit",
    "quantise",
    "refit",
    "render",
    "round",
    "sample",
    "scatter",
    "simplify",
    "summarise",
    "unwrap",
    "view",
    "weigh",
}


def test_a_class_name_is_defined_once() -> None:
    names = Counter(
        node.name
        for path in modules()
        for node in parsed(path).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert [name for name, count in names.items() if count > 1] == []


def test_a_stage_is_named_by_a_verb() -> None:
    assert [name for name in public_names_of("stages") if name.partition("_")[0] not in VERBS] == []


def test_no_module_is_too_long() -> None:
    lines = {str(path.relative_to(PACKAGE)): len(path.read_text().splitlines()) for path in modules()}
    assert {name: count for name, count in lines.items() if count > LONGEST_MODULE} == {}


def test_a_summary_in_the_help_is_short() -> None:
    summaries = [(command.help or "").strip().partition("\n")[0] for command in cli.commands.values()]
    assert [text for text in summaries if not 0 < len(text) <= LONGEST_SUMMARY] == []
