"""What has been done, in a folder that any number of processes and machines share.

    state/plan.txt                the command lines of the whole batch
    state/items.<i>-of-<n>.jsonl  what the shard has done: one writer a file, so that no disk needs locks
    state/lock.<i>-of-<n>         who writes it
    state/log/<id>                the last 64 KiB that an item printed
    state/reports.jsonl           where reports were written, which the next ones replace

A line of items.*.jsonl is an event: `run` (who began, and where), `start` (an item begins, and claims the outputs that
were not there), `end` (an attempt is over). The id of an item is the SHA-256 of its line, the contents of its inputs
and nerfbake's version: whatever changes one of them makes another item of it.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import nerfbake
from nerfbake.batch.items import Item
from nerfbake.io.digests import Stamp, digest_of, stamp_of
from nerfbake.io.journal import Event, Journal, journals, read_journal
from nerfbake.io.photographs import is_picture

DONE, FAILED, REJECTED, KILLED, WAITING = "done", "failed", "rejected", "killed", "waiting"
_MOST = 1 << 62  # of bytes, seconds, or dB
_INTERRUPTED = "the batch was killed while this ran"


class Output(NamedTuple):
    """A file or folder that an item wrote, when it was written."""

    path: str
    bytes: int
    sha256: str
    files: int | None = None  # in a folder


class Attempt(NamedTuple):
    """What came of an item the last time.

    status   done, failed, rejected (a quality budget was missed), killed
    code     the exit code; 128 and the number of the signal that killed it
    error    its line, '' where there was none
    seconds  from its start to its end
    peak     the most memory that its process had, in bytes
    read     bytes of its inputs
    psnr     dB, as it said; None: it said nothing
    number   how often it has been tried
    at       when it began: seconds since 1970
    """

    status: str
    code: int
    error: str = ""
    seconds: float = 0.0
    peak: int = 0
    read: int = 0
    outputs: tuple[Output, ...] = ()
    psnr: float | None = None
    number: int = 1
    at: float = 0.0

    @property
    def written(self) -> int:
        """Bytes of its outputs."""
        return sum(output.bytes for output in self.outputs)

    @property
    def is_possible(self) -> bool:
        """False for numbers that no attempt can have, though a state file may say so."""
        numbers = (self.code, self.seconds, self.peak, self.read, self.number, self.at)
        sizes = (each.bytes for each in self.outputs)
        return all(0 <= each < _MOST for each in (*numbers, *sizes)) and (self.psnr is None or abs(self.psnr) < _MOST)


class Input(NamedTuple):
    """What an item reads, as it is now."""

    path: str
    stamp: Stamp | None
    sha256: str | None


class Identity(NamedTuple):
    """An item as its inputs are now, and the paths that it may write."""

    id: str
    inputs: tuple[Input, ...]
    writes: tuple[str, ...] = ()
    spare: tuple[str, ...] = ()

    @property
    def read(self) -> int:
        return sum(each.stamp.bytes for each in self.inputs if each.stamp)


class State:
    """What all shards have recorded so far, and what this one adds to it."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.machines: set[str] = set()
        self._last: dict[str, Attempt] = {}
        self._done: dict[str, Attempt] = {}
        self._known: dict[str, tuple[Stamp, str]] = {}  # digests of inputs whose stamp has not changed since
        self._ours: set[str] = set()
        self._journal: Journal | None = None
        for path in journals(self.folder, "items.*.jsonl"):
            for event in read_journal(path):
                self._take(event)

    # -- looking ---------------------------------------------------------------------------------------------------
    def identify(self, item: Item, *, verify: bool = False, read: bool = True) -> Identity:
        """The item as it is now: every input is read whose size or time has changed; verify: all of them are. Without
        `read` none is, and a changed one counts as not there.
        """
        own = {_placed(path) for path in (*item.writes, *item.spare)}

        def others(file: Path) -> bool:
            absolute = _placed(file)
            return not any(absolute == path or absolute.startswith(f"{path}{os.sep}") for path in own)

        def photographs(file: Path) -> bool:
            return is_picture(file) and others(file)

        looks = [(path, path, others) for path in (*item.reads, *item.albums)]
        beside = (album for album in item.albums if not Path(album).is_dir())
        looks += [(f"photographs of {album}", str(Path(album).parent), photographs) for album in beside]
        inputs = []
        for name, path, wanted in looks:
            stamp = stamp_of(path, wanted)
            digest = None if verify else self._digest_known(name, stamp)
            if digest is None and stamp is not None and read and (digest := digest_of(path, wanted)) is not None:
                self._known[_placed(name)] = stamp, digest
            inputs.append(Input(name, stamp, digest))
        told = json.dumps([item.argv, [each.sha256 for each in inputs], nerfbake.__version__])
        return Identity(hashlib.sha256(told.encode()).hexdigest()[:32], tuple(inputs), item.writes, item.spare)

    def _digest_known(self, name: str, stamp: Stamp | None) -> str | None:
        known = self._known.get(_placed(name))
        return known[1] if known is not None and known[0] == stamp else None

    def last(self, identity: Identity) -> Attempt | None:
        """What came of it the last time. Outputs that it could not have written are left out."""
        attempt = self._last.get(identity.id)
        if attempt is None:
            return None
        own = {*identity.writes, *identity.spare}
        return attempt._replace(outputs=tuple(each for each in attempt.outputs if each.path in own))

    def done(self, identity: Identity, *, verify: bool = False) -> Attempt | None:
        """The attempt that did it, if all that the item writes is there, as large as it was; verify: and holds the
        same. A record of other outputs counts for nothing: whoever may have written it, no other file is looked at.
        """
        attempt = self._done.get(identity.id)
        if attempt is None or tuple(each.path for each in attempt.outputs) != identity.writes:
            return None
        return attempt if all(_is_there(each, verify) for each in attempt.outputs) else None

    def may_replace(self, item: Item) -> bool:
        """True if there are outputs of this item, rejected ones too, all of which this state has recorded."""
        there = [path for path in (*item.writes, *item.rejected) if os.path.lexists(path)]
        return bool(there) and all(_placed(path) in self._ours for path in there)

    # -- adding ----------------------------------------------------------------------------------------------------
    @contextmanager
    def opened(self, shard: str, machine: Mapping[str, Any], at: float) -> Iterator[None]:
        """A block in which this shard's file is written. Raises OutputError."""
        self._journal = Journal(self.folder / f"items.{shard}.jsonl")
        try:
            self._add({"event": "run", "at": at, **machine})
            yield
        finally:
            self._journal.close()

    def begin(self, item: Item, identity: Identity, at: float) -> list[str]:
        """Records that the item starts, and gives the outputs that it claims: those that were not there.

        What an attempt before has claimed stays that one's: its process may have outlived a batch that was killed, and
        may write it yet.
        """
        absent = [_placed(path) for path in (*item.writes, *item.rejected) if not os.path.lexists(path)]
        claims = [path for path in absent if path not in self._ours]
        self._add({"event": "start", "id": identity.id, "at": at, "claims": claims})
        return claims

    def end(self, item: Item, identity: Identity, attempt: Attempt, claims: Sequence[str]) -> Event:
        """Records what came of it. One that ended by itself and is not done gives back what it has claimed."""
        inputs = [
            {"path": each.path, **(each.stamp._asdict() if each.stamp else {}), "sha256": each.sha256}
            for each in identity.inputs
        ]
        unused = [path for path in claims if path in map(_placed, item.rejected)]
        event: Event = {"event": "end", "id": identity.id, "argv": item.argv, "folder": str(Path.cwd())}
        event |= {"nerfbake": nerfbake.__version__, "inputs": inputs, **attempt._asdict()}
        event["outputs"] = [output._asdict() for output in attempt.outputs]
        event["returned"] = {DONE: unused, KILLED: []}.get(attempt.status, list(claims))
        self._add(event)
        return event

    def _add(self, event: Event) -> None:
        assert self._journal is not None
        self._journal.write(event)
        self._take(event)

    # -- reading events --------------------------------------------------------------------------------------------
    def _take(self, event: Event) -> None:
        """An event of ours, or of whoever wrote to the state: what is not as we write it counts for nothing."""
        try:
            kind = event["event"]
            if kind == "run":
                self.machines.add(_machine(event))
            elif kind == "start":
                attempt = Attempt(KILLED, 137, _INTERRUPTED, at=float(event["at"]))
                if attempt.is_possible:
                    self._keep(event["id"], attempt)
                    self._ours.update(map(str, event["claims"]))
            elif kind == "end":
                self._take_end(event)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
            return

    def _take_end(self, event: Event) -> None:
        outputs = tuple(
            Output(str(each["path"]), int(each["bytes"]), str(each["sha256"]), each["files"])
            for each in event["outputs"]
        )
        status, psnr = event["status"], event["psnr"]
        if status not in (DONE, FAILED, REJECTED, KILLED):
            return
        attempt = Attempt(
            status,
            int(event["code"]),
            str(event["error"]),
            float(event["seconds"]),
            int(event["peak"]),
            int(event["read"]),
            outputs,
            None if psnr is None else float(psnr),
            int(event["number"]),
            float(event["at"]),
        )
        if not attempt.is_possible:
            return
        self._keep(event["id"], attempt)
        if attempt.status == DONE:
            self._done[event["id"]] = attempt
        for each in event["inputs"]:
            if each["sha256"] is not None:
                stamp = Stamp(each["bytes"], each["mtime"], each["files"])
                self._known[_placed(each["path"], event["folder"])] = stamp, str(each["sha256"])
        self._ours.difference_update(event["returned"])
        self._ours.update(_placed(output.path, event["folder"]) for output in outputs)

    def _keep(self, id: str, attempt: Attempt) -> None:
        """The latest of an item's attempts, from whichever file."""
        before = self._last.get(id)
        if before is None or before.at <= attempt.at:
            self._last[id] = attempt


def outputs_of(paths: Sequence[str]) -> tuple[Output, ...]:
    """Files and folders as they are now, without those that are not there."""
    found = []
    for path in paths:
        stamp, digest = stamp_of(path), digest_of(path)
        if stamp is not None and digest is not None:
            found.append(Output(path, stamp.bytes, digest, stamp.files))
    return tuple(found)


def _placed(path: str | Path, folder: str | None = None) -> str:
    """A path as seen from the root, given that it is meant from a folder; None: from where we stand."""
    return str(Path(folder or Path.cwd()) / path)


def _is_there(output: Output, verify: bool) -> bool:
    stamp = stamp_of(output.path)
    if stamp is None or (stamp.bytes, stamp.files) != (output.bytes, output.files):
        return False
    return not verify or digest_of(output.path) == output.sha256


def _machine(event: Event) -> str:
    return f"{event['machine']}, Python {event['python']}, nerfbake {event['nerfbake']}"
