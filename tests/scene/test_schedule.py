from __future__ import annotations

import pytest

from nerfbake.errors import InvalidScene
from nerfbake.scene.schedule import (
    PRESETS,
    SCENERY_PRESETS,
    Schedule,
    Stage,
    parse_schedule,
    preset_schedule,
    scenery_scale,
    scenery_schedule,
    schedule_for,
)


def test_a_schedule_reads_as_it_is_written() -> None:
    schedule = Schedule((Stage(32, 2, 1, (0.3, 0.05)), Stage(64, density=(1e-05, 1e-05), rays=2, prune=0.005)))
    text = str(schedule)
    assert text.startswith(
        "cells=32,scale=2,epochs=1,density=0.3..0.05,colour=0.4..0.1,rays=1,split=0,prune=0.01/cells=64,"
    )
    assert parse_schedule(text) == schedule
    assert parse_schedule("cells=8,density=0.2")[0].density == (0.2, 0.2)


@pytest.mark.parametrize("resolution", [16, 32, 64, 128, 256, 512])
@pytest.mark.parametrize("samples", [1, 2])
@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_is_a_schedule(name: str, resolution: int, samples: int) -> None:
    schedule = preset_schedule(name, resolution=resolution, samples=samples)
    assert schedule.resolution == resolution
    assert schedule[-1].rays == (3 if samples == 2 and name != "fast" else samples)
    assert parse_schedule(str(schedule)) == schedule


def test_long_schedules_divide_cells_twice() -> None:
    shares = {name: [stage.split for stage in preset_schedule(name)] for name in PRESETS}
    assert shares == {"fast": [0, 0, 0, 0.1], "balanced": [0, 0, 0, 0.1, 0], "best": [0, 0, 0, 0.1, 0.1, 0]}
    assert [preset_schedule(name).epochs for name in PRESETS] == [8, 11, 15]


def test_the_last_epoch_has_more_rays_and_the_rates_go_on() -> None:
    *_, first, last = preset_schedule("balanced")
    assert [(stage.epochs, stage.rays) for stage in (first, last)] == [(3, 2), (1, 3)]
    assert (first.density[1], first.colour[1]) == (last.density[0], last.colour[0])
    # A quarter of the way, geometrically.
    assert last.density[0] / last.density[1] == pytest.approx((first.density[0] / last.density[1]) ** 0.25, rel=0.01)
    assert preset_schedule("balanced", views=400)[-1].rays == 2


def test_cells_are_divided_twice_from_six_epochs_with_split_cells() -> None:
    """Figures of the schedules that `--minutes` selects: five epochs are one stage, six are two of three."""
    found = {}
    for minutes in range(1, 101):
        last = [stage.epochs for stage in schedule_for(minutes / 10, samples=1) if stage.split]
        found[sum(last)] = last
    assert [found[epochs] for epochs in (5, 6, 7)] == [[5], [3, 3], [4, 3]]


def test_large_pictures_have_finer_cells_and_coarse_stages_of_the_same_size() -> None:
    assert preset_schedule(edge=599) == preset_schedule()
    small, large = preset_schedule("best"), preset_schedule("best", edge=800)
    assert [stage.cells for stage in small] == [64, 128, 256, 256, 256, 256]
    assert [(stage.cells, stage.scale, stage.split) for stage in large] == [
        (64, 4, 0),
        (128, 4, 0),
        (256, 2, 0),
        (512, 1, 0),
        (512, 1, 0.12),
        (512, 1, 0.05),
        (512, 1, 0),
    ]
    last = {name: preset_schedule(name, edge=800)[4:] for name in PRESETS}
    assert {name: [(stage.epochs, stage.split) for stage in stages] for name, stages in last.items()} == {
        "fast": [(1, 0.04)],
        "balanced": [(3, 0.12), (1, 0)],
        "best": [(4, 0.12), (3, 0.05), (1, 0)],
    }
    assert [preset_schedule(name, edge=800)[3].epochs for name in PRESETS] == [1, 2, 2]
    assert preset_schedule("best", edge=800, resolution=256).resolution == 256


def test_pictures_of_a_large_object_are_downscaled_in_all_stages() -> None:
    whole = preset_schedule("fast", edge=800, side=767)
    assert whole == preset_schedule("fast", edge=800)
    assert [stage.scale for stage in whole] == [4, 4, 2, 1, 1]
    assert [stage.scale for stage in preset_schedule("fast", edge=800, side=768)] == [8, 8, 4, 2, 2]
    assert [stage.scale for stage in schedule_for(3, edge=800, side=1152)] == [12, 12, 6, 3, 3, 3]
    assert preset_schedule("fast", edge=800, side=4096)[0].scale == 16


@pytest.mark.parametrize("edge", [400, 800])
def test_more_minutes_are_more_epochs(edge: int) -> None:
    schedules = [schedule_for(minutes, edge=edge) for minutes in (0.1, 1, 2, 4, 100)]
    epochs = [schedule.epochs * (schedule.resolution // 256) ** 2 for schedule in schedules]
    assert epochs == sorted(epochs)
    assert epochs[0] < epochs[-1]
    assert (schedules[0].resolution, schedules[-1].resolution) == (256, 256 if edge == 400 else 512)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "stage 1 has ''; allowed: cells, scale"),
        ("epochs=2", "stage 1 has no cells; allowed: cells=64"),
        ("cells=8,cells=8", "stage 1 has 'cells=8'; allowed: .* each once"),
        ("cells=8,foo=1", "stage 1 has 'foo=1'"),
        ("cells=8,density=x", r"stage 1, density is 'x'; allowed: rates such as 0.1..0.02"),
        ("cells=8,density=1..2..3", "stage 1, density is '1..2..3'"),
        ("cells=8,epochs=1.5", "stage 1, epochs is '1.5'; allowed: a number"),
        ("cells=12", "stage 1, cells is 12; allowed: a power of two"),
        ("cells=8/cells=32", "stage 2, cells is 32; allowed: 8 or 16"),
        ("cells=8/cells=8,split=0.1/cells=16", "stage 3, cells is 16; allowed: 8, because cells are split already"),
        ("cells=8,epochs=0", "stage 1, epochs is 0; allowed: 1 to 1000"),
        ("cells=8,colour=0", "stage 1, colour is 0; allowed: rates above 0"),
        ("cells=8,prune=1", "stage 1, prune is 1; allowed: 0 or more, below 1"),
        ("cells=8,split=0.5", "stage 1, split is 0.5; allowed: 0 in the first stage"),
    ],
)
def test_what_is_no_schedule_is_one_line(text: str, message: str) -> None:
    with pytest.raises(InvalidScene, match=message):
        parse_schedule(text)


def test_what_there_is_not_is_one_line() -> None:
    with pytest.raises(InvalidScene, match="the schedule has no stages"):
        Schedule(())
    with pytest.raises(InvalidScene, match="preset is 'slow'; allowed: fast, balanced, best"):
        preset_schedule("slow")
    with pytest.raises(InvalidScene, match="minutes are 0; allowed: above 0"):
        schedule_for(0)


def test_few_views_are_seen_the_more_often() -> None:
    hundred, twenty, many = (preset_schedule("balanced", views=views) for views in (100, 20, 100_000))
    assert hundred == preset_schedule("balanced")
    assert [5 * stage.epochs for stage in hundred] == [stage.epochs for stage in twenty]
    assert {stage.epochs for stage in many} == {1}
    assert schedule_for(2, views=20).epochs == 5 * schedule_for(2).epochs


@pytest.mark.parametrize("name", SCENERY_PRESETS)
@pytest.mark.parametrize(("resolution", "edge", "factor"), [(64, 378, 4), (256, 756, 2), (256, 1008, 3), (512, 700, 1)])
def test_pictures_with_scenery_are_as_large_as_the_last_stage_needs(
    name: str, resolution: int, edge: int, factor: int
) -> None:
    schedule = scenery_schedule(name, resolution=resolution, edge=edge)
    assert schedule.finest == resolution
    assert scenery_scale(edge, schedule.finest) == factor == schedule[-1].scale
    # The schedule for the reduced pictures, which a run prints, reduces the original ones by the same factor.
    again = scenery_schedule(name, resolution=resolution, edge=edge // factor)
    assert scenery_scale(edge, parse_schedule(str(again)).finest) == factor
    assert again[-1].scale == 1


@pytest.mark.parametrize("name", SCENERY_PRESETS)
def test_larger_pictures_with_scenery_are_used_less_often(name: str) -> None:
    def epochs(pixels: float) -> list[int]:
        return [stage.epochs for stage in scenery_schedule(name, views=10, edge=384, pixels=pixels)]

    assert epochs(0) == epochs(200 * 200) == epochs(384 * 512) == [10 * each for each in epochs(10 * 384 * 512)]
    assert epochs(0) == [2 * each for each in epochs(2 * 384 * 512)]
    assert set(epochs(1e12)) == {1}
