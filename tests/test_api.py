"""The public names: each has an example that runs, and docs/api.md says what their docstrings say."""

from __future__ import annotations

import doctest
import importlib.util
import inspect
from pathlib import Path
from typing import Any

import pytest

import nerfbake
from tests.conftest import REPOSITORY
from tests.support.source import public_names


def api() -> Any:
    spec = importlib.util.spec_from_file_location("api", REPOSITORY / "docs" / "api.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_says_what_the_docstrings_say() -> None:
    assert (REPOSITORY / "docs" / "api.md").read_text() == api().page(), "`make api` writes it anew"


@pytest.mark.parametrize("name", sorted(public_names()))
def test_the_example_of_a_public_name_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = inspect.getdoc(getattr(nerfbake, name)) or ""
    example = doctest.DocTestParser().get_doctest(text, {"nerfbake": nerfbake}, name, None, 0)
    assert example.examples, f"{name} has no example"
    said: list[str] = []
    found = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(example, out=said.append)
    assert not found.failed, "".join(said)
