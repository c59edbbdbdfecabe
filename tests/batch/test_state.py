"""What makes an item another, what makes it done, and what may be replaced."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from nerfbake.batch.items import Item
from nerfbake.batch.state import DONE, FAILED, KILLED, REJECTED, Attempt, ItemIdentity, State, outputs_of
from nerfbake.io.digests import stamp_of

MACHINE = {"machine": "m", "python": "3", "nerfbake": "0"}
ITEM = Item(("svo", "a", "b"), reads=("a",), writes=("b",))


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[State]:
    monkeypatch.chdir(tmp_path)
    Path("a").write_text("input")
    state = State("run")
    with state.opened("0-of-1", MACHINE, 1.0):
        yield state


def do(state: State, item: Item = ITEM, at: float = 2.0, status: str = DONE) -> ItemIdentity:
    identity = state.identify(item)
    claims = state.begin(item, identity, at)
    if status != FAILED:
        Path(item.writes[0]).write_text("output")
    outputs = outputs_of(item.writes) if status == DONE else ()
    state.end(item, identity, Attempt(status, 0, outputs=outputs, at=at), claims)
    return identity


def test_an_item_is_done_while_its_outputs_are_as_they_were(state: State) -> None:
    identity = do(state)
    assert State("run").done(identity) is not None
    Path("b").write_text("shorter"[:3])
    assert State("run").done(identity) is None
    Path("b").write_text("tuptuo")  # as long, and something else
    assert State("run").done(identity) is not None
    assert State("run").done(identity, verify=True) is None
    Path("b").unlink()
    assert State("run").done(identity) is None


def test_an_input_that_is_touched_is_the_same_and_one_that_is_edited_is_another(state: State) -> None:
    identity = do(state)
    os.utime("a", (1, 1))
    assert State("run").identify(ITEM).id == identity.id
    Path("a").write_text("Input")
    assert State("run").identify(ITEM).id != identity.id
    Path("a").unlink()
    assert State("run").identify(ITEM).id != identity.id


def test_an_input_is_read_again_only_where_its_size_or_time_has_changed(
    state: State, monkeypatch: pytest.MonkeyPatch
) -> None:
    do(state)
    read: list[Any] = []
    monkeypatch.setattr("nerfbake.batch.state.digest_of", lambda path, wanted: read.append(path))
    fresh = State("run")
    fresh.identify(ITEM)
    assert read == []
    os.utime("a", (1, 1))
    fresh.identify(ITEM, read=False)
    assert read == []
    fresh.identify(ITEM)
    fresh.identify(ITEM, verify=True)
    assert read == ["a", "a"]


def test_another_option_or_version_makes_another_item(state: State, monkeypatch: pytest.MonkeyPatch) -> None:
    identity = state.identify(ITEM)
    assert state.identify(ITEM._replace(argv=("svo", "a", "b", "--half"))).id != identity.id
    monkeypatch.setattr("nerfbake.batch.state.__version__", "9")
    assert state.identify(ITEM).id != identity.id


def test_a_folder_counts_with_all_that_is_in_it_but_what_the_item_writes_there(state: State) -> None:
    Path("c/deep").mkdir(parents=True)
    Path("c/deep/1.png").write_text("1")
    item = Item(("fit", "c", "c/out"), albums=("c",), writes=("c/out",))
    before = state.identify(item).id
    for own in ("c/out", "c/.out.0123456789abcdef.part"):
        Path(own).write_text("own")
    assert state.identify(item).id == before
    Path("c/deep/1.png").rename("c/deep/2.png")
    assert state.identify(item).id != before


def test_photographs_beside_a_capture_count_and_other_files_there_do_not(state: State) -> None:
    Path("c/train").mkdir(parents=True)
    for name in ("transforms.json", "train/1.png", "notes.txt"):
        (Path("c") / name).write_text("1")
    item = Item(("fit", "c/transforms.json", "c/out"), albums=("c/transforms.json",), writes=("c/out",))
    before = state.identify(item).id
    Path("c/notes.txt").write_text("2")
    assert state.identify(item).id == before
    Path("c/train/1.png").write_text("2")
    assert state.identify(item).id != before


def test_what_outlives_a_killed_batch_may_be_replaced_whenever_it_is_written(state: State) -> None:
    state.begin(ITEM, state.identify(ITEM), 2.0)  # and then the batch was killed
    again = State("run")
    with again.opened("0-of-2", MACHINE, 3.0):
        do(again, at=4.0, status=FAILED)
        Path("b").write_text("output")  # by the process that nobody waits for
        assert again.may_replace(ITEM)
    assert State("run").may_replace(ITEM)


def test_a_rejected_output_of_a_killed_batch_may_be_replaced_and_one_that_nobody_claims_may_not(state: State) -> None:
    poor = Item(("svo", "a", "b"), reads=("a",), writes=("b",), spare=("b.rejected", "kept"))
    assert poor.rejected == ("b.rejected",)
    Path("kept").mkdir()
    state.begin(poor, state.identify(poor), 2.0)  # and then the batch was killed
    Path("b.rejected").write_text("output")
    assert State("run").may_replace(poor)
    Path("b").write_text("somebody's")
    state.end(poor, state.identify(poor), Attempt(FAILED, 4, at=3.0), [str(Path("b").absolute())])
    assert not State("run").may_replace(poor)


def test_only_outputs_that_the_state_has_recorded_may_be_replaced(state: State) -> None:
    assert not state.may_replace(ITEM)  # there is nothing to replace
    do(state)
    assert State("run").may_replace(ITEM)
    assert not State("elsewhere").may_replace(ITEM)
    other = Item(("svo", "a", "c"), reads=("a",), writes=("c",))
    Path("c").write_text("somebody's")
    do(state, other, status=FAILED)
    assert not State("run").may_replace(other)


def test_the_same_name_seen_from_another_folder_is_not_ours(state: State, monkeypatch: pytest.MonkeyPatch) -> None:
    do(state)
    folder = Path("run").absolute()
    Path("sub").mkdir()
    monkeypatch.chdir("sub")
    Path("b").write_text("somebody's")
    assert not State(folder).may_replace(ITEM)


def test_what_a_killed_batch_has_begun_is_ours_and_what_failed_is_not(state: State) -> None:
    state.begin(ITEM, identity := state.identify(ITEM), 2.0)
    Path("b").write_text("written, and not recorded")
    assert State("run").may_replace(ITEM)
    assert State("run").last(identity) == Attempt(KILLED, 137, "the batch was killed while this item ran", at=2.0)
    state.end(ITEM, identity, Attempt(FAILED, 1, at=2.0), ["b"])
    assert State("run").last(identity) == Attempt(FAILED, 1, at=2.0)


def test_the_latest_attempt_counts_whichever_file_it_is_in(state: State) -> None:
    do(state, at=5.0, status=FAILED)
    other = State("run")
    with other.opened("1-of-2", MACHINE, 1.0):
        identity = do(other, at=3.0)
    last = State("run").last(identity)
    assert last is not None
    assert (last.at, last.status) == (5.0, FAILED)
    assert State("run").done(identity) is not None  # the other has done it, and it is there


@pytest.mark.parametrize(
    "line",
    [
        b'{"event":"end","id":"x"}\n',
        b'{"event":"end"',
        b"[1]\nnull\n\xff\xfe\n",
        b"[" * 100000 + b"\n",
        b'{"event":"start","id":"x","at":"soon","claims":[]}\n',
        b'{"event":"start","id":{},"at":1,"claims":[]}\n',
        b'{"event":"end","id":"x","status":"done","outputs":[{"path":1}],"inputs":7}\n',
        b'{"event":"start","id":"x","at":1e999,"claims":["a"]}\n',
        b'{"event":"start","id":"x","at":1' + b"0" * 400 + b',"claims":["a"]}\n',
    ],
)
def test_lines_that_are_not_ours_count_for_nothing(line: bytes, state: State) -> None:
    identity = do(state)
    with open("run/items.0-of-1.jsonl", "ab") as file:
        file.write(line)
    again = State("run")
    with again.opened("0-of-1", MACHINE, 1.0):
        assert again.done(identity) is not None
        do(again, Item(("svo", "a", "c"), reads=("a",), writes=("c",)))
    assert State("run").may_replace(Item((), writes=("c",)))  # what comes behind a torn line is read


def test_numbers_that_no_attempt_can_have_count_for_nothing(state: State) -> None:
    identity = do(state)
    with open("run/items.0-of-1.jsonl") as file:
        end = json.loads(file.readlines()[-1])
    for name, value in (("peak", -1), ("peak", 1e999), ("seconds", float("nan")), ("psnr", 1e999), ("code", -(10**30))):
        with open("run/items.9-of-10.jsonl", "w") as file:
            file.write(json.dumps(end | {"at": 9, name: value}) + "\n")
        last = State("run").last(identity)
        assert last is not None
        assert last.at == 2.0


def test_outputs_that_the_item_does_not_write_are_neither_read_nor_taken_for_its_own(
    state: State, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A state folder may come from anybody: what it names is looked at only where this batch writes, too."""
    Path("secret.png").write_text("output")
    identity = do(state, item := ITEM._replace(spare=("b.rejected",)), status=REJECTED)
    with open("run/items.0-of-1.jsonl") as file:
        end = json.loads(file.readlines()[-1])
    (stolen,) = outputs_of(["secret.png"])
    looked: list[str] = []

    def watched(path: str, *more: object) -> object:
        looked.append(str(path))
        return stamp_of(path)

    monkeypatch.setattr("nerfbake.batch.state.stamp_of", watched)
    for status in (DONE, REJECTED):
        with open("run/items.9-of-10.jsonl", "w") as file:
            file.write(json.dumps(end | {"at": 9, "status": status, "outputs": [stolen._asdict()]}) + "\n")
        found = State("run")
        assert found.done(identity, verify=True) is None
        last = found.last(identity)
        assert last is not None
        assert (last.status, last.outputs) == (status, ())
        found.identify(item)
    assert "secret.png" not in looked
