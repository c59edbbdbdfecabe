"""PlenOctrees that lie: exit 1, one line that names the place, nothing written."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake.formats.field import n3tree as n3tree_npz
from tests.support.hostile import refused
from tests.support.n3trees import archive, held_out, quantised, sound
from tests.support.scenes import n3tree

Arrays = dict[str, Any]


def put(key: str, index: Any, value: Any) -> Callable[[Arrays], None]:
    def change(arrays: Arrays) -> None:
        arrays[key] = np.array(arrays[key])
        arrays[key][index] = value

    return change


def replace(key: str, value: Any) -> Callable[[Arrays], None]:
    return lambda arrays: arrays.update({key: value})


def drop(*keys: str) -> Callable[[Arrays], None]:
    def change(arrays: Arrays) -> None:
        for key in keys:
            del arrays[key]

    return change


def put_pixels(count: int) -> Callable[[Arrays], None]:
    return replace("held_out_pixels", np.zeros((count, 3), np.uint8))


# n3tree.md's last section, line by line: what is changed, and what the one line has to name.
LIES = {
    "negative offset": (put("child", (1, 0, 0, 0), -3), "child[1, 0, 0, 0] points to node -2; allowed: 0 (no child)"),
    "zero-sum offsets": (put("child", (2, 0, 0, 0), -1), "child[2, 0, 0, 0] points to node 1; allowed: 0 (no child)"),
    "offset to the root": (put("child", (2, 0, 0, 0), -2), "child[2, 0, 0, 0] points to node 0; allowed"),
    "offset past the end": (put("child", (0, 1, 0, 0), 9), "child[0, 1, 0, 0] points to node 9; allowed"),
    "shared child": (put("child", (0, 1, 0, 0), 2), "points to node 2, as another cell does; allowed"),
    "no cells": (replace("child", np.zeros((3, 0, 0, 0), np.int32)), "child has shape (3, 0, 0, 0); allowed"),
    "one cell": (replace("child", np.zeros((3, 1, 1, 1), np.int32)), "child has shape (3, 1, 1, 1); allowed"),
    "no nodes": (replace("child", np.zeros((0, 2, 2, 2), np.int32)), "child has shape (0, 2, 2, 2); allowed"),
    "child is flat": (replace("child", np.zeros(24, np.int32)), "child has dtype int32, shape (24,); allowed"),
    "child is float": (replace("child", np.zeros((3, 2, 2, 2))), "child has dtype float64"),
    "child beyond int32": (replace("child", np.full((3, 2, 2, 2), 2**40)), "child"),
    "data too short": (replace("data", np.zeros((2, 2, 2, 2, 4), np.float16)), "data has shape (2, 2, 2, 2, 4)"),
    "data is one number": (replace("data", np.float16(1)), "data"),
    "data is whole": (replace("data", np.zeros((3, 2, 2, 2, 4), np.int64)), "data has dtype int64; allowed"),
    "data_dim disagrees": (replace("data_dim", np.int64(28)), "data_dim is 28; allowed: 4"),
    "data_format disagrees": (replace("data_format", np.array("SH9")), "data has 4 values per cell; allowed: 28"),
    "data_format unknown": (replace("data_format", np.array("\n\x1b[2J!")), "data_format is"),
    "NaN": (put("data", (2, 0, 1, 0, 1), np.nan), "data[2, 0, 1, 0, 1] is nan; allowed: a finite number"),
    "Inf": (put("data", (2, 0, 1, 0, 1), np.inf), "data[2, 0, 1, 0, 1] is inf; allowed: a finite number"),
    "NaN density": (put("data", (2, 0, 1, 0, 3), np.nan), "data[2, 0, 1, 0, 3] is nan; allowed: a finite"),
    "negative density": (put("data", (2, 0, 1, 0, 3), -1), "data[2, 0, 1, 0, 3] is -1; allowed: a density of 0"),
    "NaN invradius": (put("invradius3", 1, np.nan), "invradius[1] is nan; allowed: a finite number above 0"),
    "zero invradius": (put("invradius3", 2, 0), "invradius[2] is 0; allowed: a finite number above 0"),
    "infinite offset": (put("offset", 0, np.inf), "offset[0] is inf; allowed: a finite number"),
    "offset of two": (replace("offset", np.zeros(2, np.float32)), "offset has shape (2,); allowed: (3,)"),
    "missing keys": (drop("child", "offset"), "npz has no child, offset; allowed"),
    "nothing": (lambda arrays: arrays.clear(), "npz has no child"),
    "object array": (replace("data", np.array([{}, []], object)), "data holds Python objects (pickle); allowed"),
    "object scalar": (replace("data_format", np.array(None, object)), "data_format holds Python objects"),
    "complex data": (replace("data", np.zeros((3, 2, 2, 2, 4), complex)), "data has dtype <c16"),
}  # fmt: skip
QUANTISED_LIES = {
    "past the codebook": (put("quant_map", (0, 2, 0, 0, 1), 16), "quant_map[0, 2, 0, 0, 1] is 16; allowed: 0 to 15"),
    "codes of another tree": (replace("quant_map", np.zeros((1, 2, 2, 2, 2), np.uint16)), "quant_map has shape"),
    "too many codebooks": (replace("quant_colors", np.zeros((2, 16, 3), np.float16)), "quant_map has shape"),
    "no codebook": (replace("quant_colors", np.zeros((1, 0, 3), np.float16)), "quant_colors has shape (1, 0, 3)"),
    "grey codebook": (replace("quant_colors", np.zeros((1, 16), np.float16)), "quant_colors has shape (1, 16)"),
    "density of another tree": (replace("sigma", np.zeros((2, 2, 2, 2), np.float16)), "sigma has shape"),
    "missing": (drop("sigma"), "npz has no sigma"),
    "retained of another tree": (replace("data_retained", np.zeros((1, 3, 2, 2, 2, 1), np.float16)), "data_retained"),
    "too much retained": (replace("data_retained", np.zeros((3, 3, 2, 2, 2, 3), np.float16)), "1 codebooks, and 3"),
    "codes are floats": (replace("quant_map", np.zeros((1, 3, 2, 2, 2), np.float32)), "quant_map has dtype float32"),
}  # fmt: skip


HELD_OUT_LIES = {
    "no pixels": (drop("held_out_pixels"), "npz has no held_out_pixels; allowed"),
    "cameras of nothing": (replace("held_out_cameras", np.zeros(0, np.uint8)), "held_out_cameras"),
    "cameras of floats": (replace("held_out_cameras", np.zeros(9)), "held_out_cameras has dtype float64, shape (9,)"),
    "cameras of no JSON": (replace("held_out_cameras", np.full(9, 65, np.uint8)), "held_out_cameras: "),
    "a pixel too few": (put_pixels(17), "held_out_pixels has dtype uint8, shape (17, 3); allowed: uint8 (18, 3)"),
    "every none": (replace("held_out_every", np.int64(0)), "held_out_every is 0; allowed: 1 to 65,536"),
    "every half": (replace("held_out_every", np.float64(0.5)), "held_out_every is 0.5; allowed: 1 to 65,536"),
    "no colour": (replace("held_out_background", np.full(3, np.nan)), "held_out_background is [nan, nan, nan]"),
    "two colours": (replace("held_out_background", np.zeros(2)), "held_out_background is [0.0, 0.0]; allowed"),
    "whole colours": (replace("held_out_background", np.zeros(3, int)), "held_out_background has dtype int64"),
}  # fmt: skip


@pytest.mark.parametrize("lie", HELD_OUT_LIES)
def test_lying_pixels_of_photographs_are_refused(lie: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    change, expected = HELD_OUT_LIES[lie]
    with np.load(io.BytesIO(b"".join(n3tree_npz.encode(n3tree(held_out=held_out()))))) as npz:
        arrays = dict(npz)
    change(arrays)
    assert expected in refused(tmp_path, archive(arrays), capfd)


@pytest.mark.parametrize("lie", LIES)
@pytest.mark.parametrize("deflated", [True, False])
def test_a_lying_tree_is_refused(lie: str, deflated: bool, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    change, expected = LIES[lie]
    arrays = sound()
    change(arrays)
    assert expected in refused(tmp_path, archive(arrays, deflated=deflated), capfd)


@pytest.mark.parametrize("lie", QUANTISED_LIES)
def test_a_lying_quantised_tree_is_refused(lie: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    change, expected = QUANTISED_LIES[lie]
    arrays = quantised()
    change(arrays)
    assert expected in refused(tmp_path, archive(arrays), capfd)


def test_a_chain_of_nodes_ends_soon(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    arrays = sound()
    arrays["child"] = np.zeros((50_000, 2, 2, 2), np.int32)
    arrays["child"][:-1, 0, 1, 0] = 1
    arrays["data"] = np.zeros((50_000, 2, 2, 2, 4), np.float16)
    assert "leads to level 20; allowed: levels 0 to 19" in refused(tmp_path, archive(arrays), capfd)
