"""Parse the JSON output of commands, and validate it with the published schemas."""

from __future__ import annotations

import json
from functools import cache
from typing import Any, NoReturn

from jsonschema import Draft202012Validator
from jsonschema.exceptions import best_match

from tests.conftest import REPOSITORY

SCHEMAS = REPOSITORY / "schemas" / "json"
SUFFIX = ".schema.json"


@cache
def validator(name: str) -> Draft202012Validator:
    """The validator for the schema of an output: `info`, `batch-plan`, ..."""
    return Draft202012Validator(json.loads((SCHEMAS / f"{name}{SUFFIX}").read_text()))


def read_output(name: str, text: str | bytes) -> Any:
    """Parse an output. Fails if it is not strict JSON (without NaN), or if it does not match its schema."""
    facts = json.loads(text, parse_constant=_refuse)
    fault = best_match(validator(name).iter_errors(facts))
    assert fault is None, f"{name}, {fault.json_path}: {fault.message}"
    return facts


def _refuse(constant: str) -> NoReturn:
    raise AssertionError(f"{constant} is no JSON")
