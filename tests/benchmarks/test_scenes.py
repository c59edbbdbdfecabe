from __future__ import annotations

import zipfile

import pytest

from benchmarks.scenes import DATA, SAMPLES, Scenes
from nerfbake import N3Tree, load
from tests import conftest
from tests.benchmarks.conftest import EDGE


def test_a_sample_is_made_once(scenes: Scenes) -> None:
    path = scenes.sample("sample_128")
    before = path.stat().st_mtime_ns
    assert scenes.sample("sample_128") == path
    assert path.stat().st_mtime_ns == before
    assert load(path, N3Tree).data_format == "SH9"


def test_a_deflated_sample_is_the_same_tree(scenes: Scenes) -> None:
    path = scenes.sample("sample_sh16")
    assert {entry.compress_type for entry in zipfile.ZipFile(path).infolist()} == {zipfile.ZIP_DEFLATED}
    assert load(path, N3Tree).data_format == "SH16"
    assert path.stat().st_size < 4 * (EDGE**3) * 49


def test_benchmarks_and_tests_look_for_the_real_scenes_in_the_same_place() -> None:
    assert DATA == conftest.DATA


@pytest.mark.data
def test_every_real_scene_is_where_the_suite_looks_for_it(tmp_path: object) -> None:
    real = Scenes(DATA, DATA)
    missing = [
        path
        for path in (real.chair, real.views, real.test_cameras, real.nerf_synthetic, real.stage1)
        if not path.exists()
    ]
    assert missing == []
    assert SAMPLES["sample SH16"].resolution == 256
