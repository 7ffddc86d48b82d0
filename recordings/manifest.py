"""Metadata of a recording: the manifest of a finished folder, the journal of an unfinished one."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic

from recordings.errors import RecordingError
from recordings.files import write_at_once
from recordings.layout import FORMAT_VERSION, Key, Layout
from recordings.plan import Facts, Kind, Plan, S, described, digest, stored_layout

MANIFEST = "manifest.json"


class DamagedManifestError(RecordingError):
    """The manifest exists but does not match its checksum."""


@dataclass(frozen=True)
class Record:
    """A finished item: the checksum of its bytes, and its notes."""

    checksum: str
    notes: dict[str, Any]


@dataclass(frozen=True)
class Manifest(Generic[S]):
    """Everything about a finished recording except its arrays.

    It does not depend on when, where or by how many processes it was made: equal data have equal manifests.
    """

    plan: Plan[S]
    facts: Facts
    records: dict[Key, Record]
    fingerprint: str

    @property
    def settings(self) -> S:
        """Settings of the recording."""
        return self.plan.settings

    @property
    def layout(self) -> Layout:
        """Its arrays and the number of items per split."""
        return self.plan.layout

    @property
    def content(self) -> str:
        """32 hex digits over all items' checksums; equal only for equal bytes."""
        return digest([self.records[key].checksum for key in self.layout.all_keys()])

    def notes(self, split: str, index: int) -> dict[str, Any]:
        """The notes of an item."""
        return self.records[split, index].notes


def read_manifest(root: Path, kind: Kind[S]) -> Manifest[S]:
    """Reads the manifest of a finished folder.

    Raises:
        RecordingError: no folder, not finished, damaged, of another kind, or written by another version; each with the
            command that helps.
    """
    path = root / MANIFEST
    try:
        text = path.read_text(encoding="utf-8")
    except (FileNotFoundError, NotADirectoryError):
        raise RecordingError(_why_missing(root, kind)) from None
    except UnicodeDecodeError:
        raise _damaged(path, kind) from None
    except OSError as error:
        raise RecordingError(f"{path} cannot be read ({error.strerror}): check its permissions and that disk") from None
    try:
        data = json.loads(text)
        if data["format"] != FORMAT_VERSION:
            raise _other_format(root, kind, data["format"])
        if data.pop("checksum") != digest(data):
            raise _damaged(path, kind)
        plan = _plan(root, kind, data)
        records = {}
        for split, count in plan.layout.counts.items():
            part = data["splits"][split]
            columns = [part["checksums"], *(part[note] for note in kind.notes)]
            if any(len(column) != count for column in columns):
                raise _damaged(path, kind)
            for index, (checksum, *notes) in enumerate(zip(*columns, strict=True)):
                records[split, index] = Record(checksum, dict(zip(kind.notes, notes, strict=True)))
        known = {"format", "fingerprint", "content", "settings", "arrays", "splits"}
        facts = _facts(plan, data, known)
        return Manifest(plan, facts, records, data["fingerprint"])
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise _damaged(path, kind) from None


def write_manifest(root: Path, manifest: Manifest[S]) -> None:
    """Writes the manifest atomically; from then on the folder counts as finished."""
    plan = manifest.plan
    stored = stored_layout(plan)
    data: dict[str, Any] = {
        "format": FORMAT_VERSION,
        **_identity(plan),
        "fingerprint": manifest.fingerprint,
        "content": manifest.content,
        "settings": plan.kind.dump(plan.settings),
        **manifest.facts,
        "arrays": described(plan.layout, meanings=False),
        **stored,
        "splits": {split: _split(manifest, split, count) for split, count in plan.layout.counts.items()},
    }
    data["checksum"] = digest(data)
    write_at_once(root / MANIFEST, json.dumps(data, indent=1) + "\n")


def _split(manifest: Manifest[S], split: str, count: int) -> dict[str, Any]:
    kind = manifest.plan.kind
    records = [manifest.records[split, index] for index in range(count)]
    columns: dict[str, Any] = {}
    for note in kind.notes:
        if note in kind.totals:
            columns[f"{note}_total"] = sum(record.notes[note] for record in records)
        columns[note] = [record.notes[note] for record in records]
    return {kind.items: count, **columns, "checksums": [record.checksum for record in records]}


class Journal(Generic[S]):
    """`<items>.jsonl`: a first line with settings and facts, then one line per finished item.

    One process writes it, under the folder's lock. Items with unreadable lines are made again.
    """

    def __init__(self, root: Path, plan: Plan[S], facts: Facts, records: Mapping[Key, Record]) -> None:
        """Writes a new journal, replacing an old one."""
        self.path = root / plan.kind.journal
        write_at_once(self.path, "".join(f"{json.dumps(line)}\n" for line in _lines(plan, facts, records)))
        self.file = os.open(self.path, os.O_WRONLY | os.O_APPEND)

    def append(self, key: Key, record: Record) -> None:
        """Records that an item's bytes have been written."""
        line = (json.dumps(_line(key, record)) + "\n").encode()
        if os.write(self.file, line) != len(line):  # a disk that fills up accepts a part of the line
            os.write(self.file, b"\n")

    def close(self) -> None:
        """Closes the file."""
        os.close(self.file)


def read_journal(root: Path, kind: Kind[S]) -> tuple[Plan[S], Facts, dict[Key, Record]] | None:
    """Plan, facts and finished items of a folder's journal; None if there is no journal.

    Raises:
        RecordingError: its first line is damaged or was written by another version or kind.
    """
    path = root / kind.journal
    if not path.exists():
        return None
    head, *lines = path.read_bytes().split(b"\n")
    try:
        data = json.loads(head)
        if data["format"] != FORMAT_VERSION:
            raise _other_format(root, kind, data["format"])
        plan = _plan(root, kind, data)
        facts = _facts(plan, data, {"format", "settings"})
        if any(data[name] != value for name, value in _identity(plan).items()):
            raise RecordingError(f"{root} was started by another version of this program: {_make_elsewhere(kind)}")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise RecordingError(
            f"the first line of {path} is damaged: delete {root} and generate the data again"
        ) from None
    known = set(plan.layout.all_keys())
    records = {}
    for line in lines:
        try:
            entry = json.loads(line)
            key = (entry["split"], entry["index"])
            record = Record(entry["checksum"], {note: entry[note] for note in kind.notes})
            if key in known:
                records[key] = record
        except (ValueError, KeyError, TypeError, RecursionError):
            continue
    return plan, facts, records


def journal_matches(root: Path, manifest: Manifest[S]) -> bool:
    """Whether the journal of a finished folder holds what it shall: the manifest can be written again from it."""
    wanted = _lines(manifest.plan, manifest.facts, manifest.records)
    try:
        lines = (root / manifest.plan.kind.journal).read_bytes().splitlines()
        return len(lines) == len(wanted) and all(
            json.loads(line) == json.loads(json.dumps(want)) for line, want in zip(lines, wanted, strict=True)
        )
    except (OSError, ValueError, RecursionError):
        return False


def _lines(plan: Plan[S], facts: Facts, records: Mapping[Key, Record]) -> list[dict[str, Any]]:
    settings = plan.kind.dump(plan.settings)
    head = {"format": FORMAT_VERSION, **_identity(plan), "settings": settings, **stored_layout(plan), **facts}
    return [head, *(_line(key, records[key]) for key in plan.layout.all_keys() if key in records)]


def _line(key: Key, record: Record) -> dict[str, Any]:
    return {"split": key[0], "index": key[1], "checksum": record.checksum, **record.notes}


def _identity(plan: Plan[S]) -> dict[str, Any]:
    return plan.kind.identity(plan.settings) if plan.kind.describes_itself else {}


def _facts(plan: Plan[S], data: dict[str, Any], known: set[str]) -> Facts:
    """The entries that are facts of the maker: all besides those that every manifest or journal has."""
    known = known | set(stored_layout(plan)) | set(_identity(plan))
    facts = {name: value for name, value in data.items() if name not in known}
    if not isinstance(facts["versions"], dict):
        raise TypeError("versions")
    return facts


def _plan(root: Path, kind: Kind[S], data: dict[str, Any]) -> Plan[S]:
    described_by = data.get("kind")
    if (described_by is None) != (not kind.describes_itself) or described_by not in (None, kind.name):
        raise RecordingError(f"{root} holds {described_by or 'data of another kind'}, not {kind.name}: choose another")
    try:
        settings = kind.parse(data["settings"])
    except ValueError:
        raise RecordingError(
            f"{root} was made by another version of this program (its settings are unknown here): "
            f"{_make_elsewhere(kind)}"
        ) from None
    return Plan(kind, settings, kind.layout(settings, data))


def _why_missing(root: Path, kind: Kind[S]) -> str:
    found = read_journal(root, kind) if root.is_dir() else None
    command = kind.make_command.format(root=root)
    if found is None:
        return f"no {kind.name} data at {root}: make them with {command}"
    made, wanted = len(found[2]), len(found[0].layout.all_keys())
    return f"{root} is not finished ({made} of {wanted} {kind.items} made): resume with {command}"


def _other_format(root: Path, kind: Kind[S], found: object) -> RecordingError:
    return RecordingError(
        f"{root} was written in format {found!r} and this program reads format {FORMAT_VERSION}: "
        f"{_make_elsewhere(kind)}"
    )


def _make_elsewhere(kind: Kind[S]) -> str:
    return f"generate the data again in another folder with {kind.make_command.format(root='ANOTHER_FOLDER')}"


def _damaged(path: Path, kind: Kind[S]) -> DamagedManifestError:
    return DamagedManifestError(f"{path} is damaged: repair it with {kind.repair_command.format(root=path.parent)}")
