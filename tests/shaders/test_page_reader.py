"""The page's script as a reader: the frozen .svoq files, and what stands at points by the hundred thousand."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake import SparseVoxelOctree, build_octree, sample_n3tree
from nerfbake.formats.page.triangles import package_text
from nerfbake.io import load_page_content
from nerfbake.scene.page import WIDE
from tests.conformance.case import HOME, require_like
from tests.support.browser import Browser, Seen
from tests.support.octrees import points_around
from tests.support.viewed import Made, compressed_page

pytestmark = [pytest.mark.tools, pytest.mark.slow]
POINTS = 60_000

# The page keeps its functions to itself: the same files once more.
SCRIPT = "".join(package_text(name) for name in ("svoq.js", "svoq_values.js", "field.js"))

# What they find in a .svoq: numbers as they stand, and of each leaf its node and its values.
READ = """(text) => {
  const through = (work) => { for (;;) { const {value, done} = work.next(); if (done) return value; } };
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const octree = through(readSvoq(bytes)), size = new DataView(bytes.buffer), {C, mixing} = octree;
  const edge = 2 ** Math.ceil(Math.log2(Math.max(...[8, 10, 12].map((at) => size.getUint16(at, true)))));
  const leaves = [];
  through(eachLeaf(octree, edge, 0, (node, x, y, z, width, held, at) => {
    const values = Array.from({length: C}, (_, k) => k === C - 1
      ? octree.densityScale * Math.expm1(Math.max(held[at + k], 0))
      : mixing.subarray(k * (C - 1), (k + 1) * (C - 1)).reduce((sum, part, i) => sum + part * held[at + i], 0));
    leaves.push([node, values]);
  }));
  return {masks: [...octree.nodes.masks], C, values: [...octree.values.subarray(0, octree.values.length - C)], leaves};
}"""

# Of points in the octree's voxels the row that each lies in, -1 for none.
ROWS = """async (text) => {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)), points = new Float32Array(bytes.buffer);
  const {top, blocks, texels} = await nerfbake.carried.arrays(), {shape, start, box} = nerfbake.facts;
  const rows = new Int32Array(points.length / 3).fill(-1);
  for (let i = 0; i < rows.length; i++) {
    let [x, y, z] = [0, 1, 2].map((axis) => Math.floor(points[3 * i + axis]) - start[axis]);
    if (![x, y, z].every((at, axis) => at >= box[0][axis] && at < box[1][axis])) continue;
    const here = top[((x >> 3) * shape[1] + (y >> 3)) * shape[2] + (z >> 3)];
    if (here < 0) continue;
    const at = here < WHOLE ? 4 * blockAt(here, x, y, z) : 0;
    if (here < WHOLE && (blocks[at + 3] >> (WIDE + octantAt(x, y, z))) & 1) [x, y, z] = [x & ~1, y & ~1, z & ~1];
    const there = here >= WHOLE || blocks[at + 3] === ALL || (blocks[at + ((x >> 1) & 1)] >>> bitAt(x, y, z)) & 1;
    if (there) rows[i] = rowAt(top, blocks, shape, x, y, z);
  }
  return {rows: textOf(rows), texels: textOf(texels)};
}"""


@pytest.fixture(scope="module")
def made(folder: Path) -> Made:
    """A box with leaves of several sizes that reach out of it: two of its edges are no powers of two."""
    octree = replace(build_octree(sample_n3tree(resolution=32, basis="SH4")), size=(30, 32, 21))
    made = compressed_page(folder / "reader.html", octree)
    assert (made.arrays.blocks[:, 3] >= 1 << WIDE).sum() > 50
    return made


@pytest.fixture(scope="module")
def page(browser: Browser, made: Made) -> Iterator[Seen]:
    with browser.opened(made.path) as found:
        found.wait_until_ready()
        yield found


def asked(page: Seen, function: str, data: bytes) -> Any:
    """What a function of the bytes in base64 finds, which sees the page's own."""
    return page.ask(f"(text) => {{ {SCRIPT} return ({function})(text); }}", base64.b64encode(data).decode())


@pytest.mark.parametrize("name", ["rgba", "sh4"])
def test_a_frozen_file_is_what_its_json_says(page: Seen, name: str) -> None:
    expected = json.loads((HOME / f"compressed/{name}.expected.json").read_text())
    found = asked(page, READ, (HOME / f"compressed/{name}_range.svoq").read_bytes())
    assert found["masks"] == expected["masks"]
    values = np.array(found["values"]).reshape(-1, found["C"])
    assert values.tolist() == expected["values"]
    leaves = [values for _, values in sorted(found["leaves"])]
    assert len(leaves) == len(values)
    lookups = [{"leaf": each["leaf"], "values": leaves[each["leaf"]]} for each in expected["lookups"]]
    require_like(lookups, expected["lookups"], expected["tolerance"], kind="computed")


def test_the_other_coding_is_refused_in_a_sentence(page: Seen) -> None:
    """No page carries it: `nerfbake view` codes it anew."""
    with pytest.raises(Exception, match="the octree is of a version that this page does not know"):
        asked(page, READ, (HOME / "compressed/sh4_deflate.svoq").read_bytes())


def test_a_hundred_thousand_points_give_the_same_voxels(page: Seen, made: Made) -> None:
    octree = load_page_content(made.path)
    assert isinstance(octree, SparseVoxelOctree)
    octree = replace(octree, origin=np.zeros(3), voxel_size=np.ones(3))
    points = points_around(octree, POINTS)
    assert len(points) > 100_000
    told = asked(page, ROWS, points.tobytes())
    rows = np.frombuffer(base64.b64decode(told["rows"]), np.int32)
    texels = np.frombuffer(base64.b64decode(told["texels"]), np.float16).reshape(-1, made.arrays.texels[0].size)
    expected = octree.sample(points.astype(np.float64))
    seen = expected[:, -1] > 0
    assert 0.02 < seen.mean() < 0.9
    assert ((rows >= 0) != seen).sum() == 0
    assert (texels[rows[seen]].view(np.uint16) != halves_of(expected[seen], made).view(np.uint16)).sum() == 0


def halves_of(values: npt.NDArray[np.float32], made: Made) -> npt.NDArray[Any]:
    """Texels as nerfbake/scene/page.py draws them: of SH4 red, green, blue and sigma, then the other nine."""
    first, others = values[:, [0, 4, 8]], values[:, [1, 5, 9, 2, 6, 10, 3, 7, 11]]
    sigma = values[:, 12:] / np.float32(made.arrays.density_unit)
    row = np.concatenate([first, sigma, others], axis=1)
    padded = np.zeros((len(row), made.arrays.texels[0].size))
    padded[:, : row.shape[1]] = row
    return padded.astype(np.float16)
