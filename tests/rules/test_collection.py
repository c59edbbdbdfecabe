"""Collecting tests computes nothing: every worker imports every module of tests."""

from __future__ import annotations

import pytest

from tests.conftest import RUN_AT_IMPORT


def test_no_kernel_runs_when_a_module_of_tests_is_imported(pytestconfig: pytest.Config) -> None:
    """A kernel that ran was compiled, or loaded: move the call into a fixture, or a function with @cache."""
    assert pytestconfig.stash[RUN_AT_IMPORT] == []
