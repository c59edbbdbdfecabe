"""The state of a batch: a folder of records that several processes and machines can share.

    state/plan.txt                the command lines of the whole batch
    state/items.<i>-of-<n>.jsonl  events of a shard: one writer per file, so that shards need no locks between them
    state/lock.<i>-of-<n>         the process that writes this shard's events
    state/log/<id>                the last 64 KiB that an item printed
    state/reports.jsonl           paths of the reports, which later reports may replace

Each line of items.*.jsonl is an event: `run` (a batch starts, on this machine), `start` (an attempt starts, and claims
the outputs that do not exist yet), or `end` (the attempt has ended). The id of an item comes from the SHA-256 of its
arguments, the hashes of its inputs and the version of nerfbake. If one of them changes, it is a new item.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from nerfbake import __version__
from nerfbake.batch.items import Item
from nerfbake.errors import one_line
from nerfbake.io.digests import Stamp, digest_of, stamp_of
from nerfbake.io.journal import Event, Journal, journals, read_journal
from nerfbake.io.reading import is_picture

DONE, FAILED, REJECTED, KILLED, WAITING = "done", "failed", "rejected", "killed", "waiting"
_MOST = 1 << 62  # limit for bytes, seconds and dB
_INTERRUPTED = "the batch was killed while this item ran"


class OutputRecord(NamedTuple):
    """A file or folder that an item wrote, as it was at the end of the attempt."""

    path: str
    bytes: int
    sha256: str
    files: int | None = None  # number of files in a folder; None for a single file


class Attempt(NamedTuple):
    """An attempt to run an item.

    status   done, failed, rejected (a quality budget was missed) or killed
    code     exit code; 128 plus the signal number if a signal killed the process
    error    error message; '' if there was none
    seconds  run time
    peak     peak memory of the process, in bytes
    read     total size of the inputs, in bytes
    psnr     PSNR of the output in dB; None if the command reported none
    number   number of the attempt in its run, from 1
    at       start time, in seconds since 1970
    """

    status: str
    code: int
    error: str = ""
    seconds: float = 0.0
    peak: int = 0
    read: int = 0
    outputs: tuple[OutputRecord, ...] = ()
    psnr: float | None = None
    number: int = 1
    at: float = 0.0

    @property
    def written(self) -> int:
        """Total size of the outputs, in bytes."""
        return sum(output.bytes for output in self.outputs)

    @property
    def is_possible(self) -> bool:
        """False if a number is out of range, as it may be in a damaged or hostile state file."""
        numbers = (self.code, self.seconds, self.peak, self.read, self.number, self.at)
        sizes = (each.bytes for each in self.outputs)
        return all(0 <= each < _MOST for each in (*numbers, *sizes)) and (self.psnr is None or abs(self.psnr) < _MOST)


class InputRecord(NamedTuple):
    """An input of an item, as it is now. sha256: None if it does not exist or was not read."""

    path: str
    stamp: Stamp | None
    sha256: str | None


class ItemIdentity(NamedTuple):
    """The id of an item, from its inputs as they are now, and the paths that it may write."""

    id: str
    inputs: tuple[InputRecord, ...]
    writes: tuple[str, ...] = ()
    spare: tuple[str, ...] = ()

    @property
    def read(self) -> int:
        """Total size of the inputs, in bytes."""
        return sum(each.stamp.bytes for each in self.inputs if each.stamp)


class State:
    """The records of all shards so far, and the records that this process adds."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.machines: set[str] = set()
        self._last: dict[str, Attempt] = {}
        self._done: dict[str, Attempt] = {}
        self._known: dict[str, tuple[Stamp, str]] = {}  # hash of each input, valid for this stamp
        self._ours: set[str] = set()
        self._journal: Journal | None = None
        for path in journals(self.folder, "items.*.jsonl"):
            for event in read_journal(path):
                self._apply(event)

    # -- finding attempts --------------------------------------------------------------------------------------------
    def identify(self, item: Item, *, verify: bool = False, read: bool = True) -> ItemIdentity:
        """Return the identity of an item from its inputs as they are now.

        Hashes the inputs whose size or modification time has changed. verify: hash all inputs. read=False: hash none,
        and treat a changed input as missing.
        """
        outputs = {_absolute(path) for path in (*item.writes, *item.spare)}

        def is_input(file: Path) -> bool:
            absolute = _absolute(file)
            return not any(absolute == path or absolute.startswith(f"{path}{os.sep}") for path in outputs)

        def is_photograph(file: Path) -> bool:
            return is_picture(file) and is_input(file)

        sources = [(path, path, is_input) for path in (*item.reads, *item.albums)]
        files = (album for album in item.albums if not Path(album).is_dir())
        sources += [(f"photographs of {album}", str(Path(album).parent), is_photograph) for album in files]
        inputs = []
        for name, path, wanted in sources:
            stamp = stamp_of(path, wanted)
            digest = None if verify else self._digest_known(name, stamp)
            if digest is None and stamp is not None and read and (digest := digest_of(path, wanted)) is not None:
                self._known[_absolute(name)] = stamp, digest
            inputs.append(InputRecord(name, stamp, digest))
        content = json.dumps([item.argv, [each.sha256 for each in inputs], __version__])
        return ItemIdentity(hashlib.sha256(content.encode()).hexdigest()[:32], tuple(inputs), item.writes, item.spare)

    def _digest_known(self, name: str, stamp: Stamp | None) -> str | None:
        known = self._known.get(_absolute(name))
        return known[1] if known is not None and known[0] == stamp else None

    def last(self, identity: ItemIdentity) -> Attempt | None:
        """Return the last attempt of an item, or None. Leaves out outputs that the item does not declare."""
        attempt = self._last.get(identity.id)
        if attempt is None:
            return None
        declared = {*identity.writes, *identity.spare}
        return attempt._replace(outputs=tuple(each for each in attempt.outputs if each.path in declared))

    def done(self, identity: ItemIdentity, *, verify: bool = False) -> Attempt | None:
        """Return the attempt that makes an item done, or None.

        Its outputs must exist with their recorded sizes. verify: also with their recorded hashes. A record with other
        outputs than the item declares is ignored, so that a hostile state cannot make this function open other files.
        """
        attempt = self._done.get(identity.id)
        if attempt is None or tuple(each.path for each in attempt.outputs) != identity.writes:
            return None
        return attempt if all(_is_unchanged(each, verify) for each in attempt.outputs) else None

    def may_replace(self, item: Item) -> bool:
        """True if outputs of this item exist, rejected ones included, and the state has recorded all of them."""
        existing = [path for path in (*item.writes, *item.rejected) if os.path.lexists(path)]
        return bool(existing) and all(_absolute(path) in self._ours for path in existing)

    # -- recording ---------------------------------------------------------------------------------------------------
    @contextmanager
    def opened(self, shard: str, machine: Mapping[str, Any], at: float) -> Iterator[None]:
        """Open the event file of this shard for the duration of the block. Raises OutputError."""
        self._journal = Journal(self.folder / f"items.{shard}.jsonl")
        try:
            self._add({"event": "run", "at": at, **machine})
            yield
        finally:
            self._journal.close()

    def begin(self, item: Item, identity: ItemIdentity, at: float) -> list[str]:
        """Record the start of an attempt, and return the outputs that it claims: those that do not exist yet.

        Claims of earlier attempts remain: the process of a killed batch may still be running, and may still write them.
        """
        absent = [_absolute(path) for path in (*item.writes, *item.rejected) if not os.path.lexists(path)]
        claims = [path for path in absent if path not in self._ours]
        self._add({"event": "start", "id": identity.id, "at": at, "claims": claims})
        return claims

    def end(self, item: Item, identity: ItemIdentity, attempt: Attempt, claims: Sequence[str]) -> Event:
        """Record the end of an attempt, and return the event.

        An attempt that failed or was rejected returns all its claims. One that is done returns those of rejected
        outputs. A killed one returns none.
        """
        inputs = [
            {"path": each.path, **(each.stamp._asdict() if each.stamp else {}), "sha256": each.sha256}
            for each in identity.inputs
        ]
        unused = [path for path in claims if path in map(_absolute, item.rejected)]
        event: Event = {"event": "end", "id": identity.id, "argv": item.argv, "folder": str(Path.cwd())}
        event |= {"nerfbake": __version__, "inputs": inputs, **attempt._asdict()}
        event["outputs"] = [output._asdict() for output in attempt.outputs]
        event["returned"] = {DONE: unused, KILLED: []}.get(attempt.status, list(claims))
        self._add(event)
        return event

    def _add(self, event: Event) -> None:
        assert self._journal is not None
        self._journal.write(event)
        self._apply(event)

    # -- applying events ---------------------------------------------------------------------------------------------
    def _apply(self, event: Event) -> None:
        """Apply an event of this process or from a state file. Malformed events are ignored."""
        try:
            kind = event["event"]
            if kind == "run":
                self.machines.add(_machine(event))
            elif kind == "start":
                attempt = Attempt(KILLED, 137, _INTERRUPTED, at=float(event["at"]))
                if attempt.is_possible:
                    self._store(event["id"], attempt)
                    self._ours.update(map(str, event["claims"]))
            elif kind == "end":
                self._apply_end(event)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
            return

    def _apply_end(self, event: Event) -> None:
        outputs = tuple(
            OutputRecord(str(each["path"]), int(each["bytes"]), str(each["sha256"]), each["files"])
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
        self._store(event["id"], attempt)
        if attempt.status == DONE:
            self._done[event["id"]] = attempt
        for each in event["inputs"]:
            if each["sha256"] is not None:
                stamp = Stamp(each["bytes"], each["mtime"], each["files"])
                self._known[_absolute(each["path"], event["folder"])] = stamp, str(each["sha256"])
        self._ours.difference_update(event["returned"])
        self._ours.update(_absolute(output.path, event["folder"]) for output in outputs)

    def _store(self, id: str, attempt: Attempt) -> None:
        """Store an attempt unless a later one is known. The files of several shards are read in any order."""
        before = self._last.get(id)
        if before is None or before.at <= attempt.at:
            self._last[id] = attempt


def outputs_of(paths: Sequence[str]) -> tuple[OutputRecord, ...]:
    """The records of files and folders as they are now, without those that do not exist."""
    found = []
    for path in paths:
        stamp, digest = stamp_of(path), digest_of(path)
        if stamp is not None and digest is not None:
            found.append(OutputRecord(path, stamp.bytes, digest, stamp.files))
    return tuple(found)


def _absolute(path: str | Path, folder: str | None = None) -> str:
    """Return the absolute path of a path relative to a folder. folder: None is the working directory."""
    return str(Path(folder or Path.cwd()) / path)


def _is_unchanged(output: OutputRecord, verify: bool) -> bool:
    """True if an output exists with its recorded size; verify: also with its recorded hash."""
    stamp = stamp_of(output.path)
    if stamp is None or (stamp.bytes, stamp.files) != (output.bytes, output.files):
        return False
    return not verify or digest_of(output.path) == output.sha256


def _machine(event: Event) -> str:
    return one_line(f"{event['machine']}, Python {event['python']}, nerfbake {event['nerfbake']}")
