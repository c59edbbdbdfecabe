from __future__ import annotations

import io
import zipfile
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerfbake.formats.octree import npz as octree_npz
from nerfbake.formats.wire import npz
from nerfbake.scene.octree import SparseVoxelOctree
from tests.support.scenes import assert_same_octree, octrees


def written(octree: SparseVoxelOctree, **options: Any) -> bytes:
    return b"".join(octree_npz.encode(octree, **options))


@given(octrees(), st.sampled_from([0, -1]))
def test_round_trips_are_exact(octree: SparseVoxelOctree, no_child: int) -> None:
    data = written(octree, no_child=no_child)
    assert octree_npz.recognise(memoryview(data[:512]))
    assert_same_octree(octree_npz.decode(memoryview(data)), octree)
    assert written(octree, no_child=no_child) == data


@given(octrees())
def test_numpy_alone_reads_it(octree: SparseVoxelOctree) -> None:
    with np.load(io.BytesIO(written(octree))) as archive:
        assert archive["size"].tolist() == list(octree.size)
        assert archive["node_children"].tobytes() == octree.node_children.tobytes()
        assert archive["node_data"].dtype == octree.node_data.dtype
        assert archive["node_data"].tobytes() == octree.node_data.tobytes()
        assert archive["level_sizes"].tolist() == octree.level_sizes
        assert str(archive["data_format"]) == octree.data_format


@given(octrees())
def test_arrays_start_at_multiples_of_64_bytes_and_are_read_as_views(octree: SparseVoxelOctree) -> None:
    data = written(octree)
    for info in zipfile.ZipFile(io.BytesIO(data)).infolist():
        name, extra = (int.from_bytes(data[info.header_offset + at :][:2], "little") for at in (26, 28))
        assert (info.header_offset + 30 + name + extra) % 64 == 0
    back = octree_npz.decode(memoryview(data))
    assert not back.node_data.flags.owndata
    assert back.node_data.ctypes.data % 4 == np.frombuffer(data, np.uint8).ctypes.data % 4


@given(octrees())
def test_archives_beyond_32_bits_are_zip64(octree: SparseVoxelOctree) -> None:
    # The real limit is 4 GiB; the same code at 1 KiB.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(npz, "_ZIP64_FROM", 1024)
        data = written(octree)
    with np.load(io.BytesIO(data)) as archive:
        assert archive["node_data"].tobytes() == octree.node_data.tobytes()
    assert zipfile.ZipFile(io.BytesIO(data)).testzip() is None
    assert_same_octree(octree_npz.decode(memoryview(data)), octree)
