"""Metadata of a P2D folder: the manifest of a finished one, the journal of an unfinished one."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sims.errors import SimError
from sims.p2d.settings import Settings
from sims.p2d.store import FIELDS, FORMAT_VERSION, SPLITS, Key, counts, keys

MANIFEST = "manifest.json"
JOURNAL = "trajectories.jsonl"

SIMULATION_VERSION = 1
"""Raise whenever the simulation gives other bytes for the same settings, so that old and new data are not mixed."""

Facts = dict[str, Any]
"""Facts of the simulator: `versions` (name -> version of everything that determines bytes), `camera`, `classes`."""


class DamagedManifestError(SimError):
    """The manifest exists but does not match its checksum."""


@dataclass(frozen=True)
class Record:
    """A finished trajectory: the checksum of its bytes, the number of attempts rejected before it."""

    checksum: str
    redraws: int


@dataclass(frozen=True)
class Manifest:
    """Everything about a finished data set except its arrays.

    It does not depend on when, where or by how many processes the data were generated: equal data have equal manifests.
    """

    settings: Settings
    facts: Facts
    records: dict[Key, Record]
    fingerprint: str

    @property
    def content(self) -> str:
        """32 hex digits over all trajectories' checksums; equal only for equal bytes."""
        return _digest([self.records[key].checksum for key in keys(self.settings)])

    @property
    def classes(self) -> list[str]:
        """Class names, indexed by the values of array `classes`."""
        return list(self.facts["classes"])


def fingerprint(settings: Settings) -> str:
    """16 hex digits over the settings and the versions of simulation and format.

    Package versions are in the manifest instead (`facts["versions"]`), because prepared data must be found by their
    settings on machines without the simulator too.
    """
    wish = {"format": FORMAT_VERSION, "simulation": SIMULATION_VERSION, "settings": settings.model_dump(mode="json")}
    return _digest(wish)[:16]


def difference(there: Settings, wished: Settings) -> str | None:
    """The first setting that differs, in words; None for equal settings."""
    for name in Settings.model_fields:
        old, new = getattr(there, name), getattr(wished, name)
        if old != new:
            return f"{name} is {old!r} there and {new!r} here"
    return None


def read_manifest(root: Path) -> Manifest:
    """Reads the manifest of a finished folder.

    Raises:
        SimError: no folder, not finished, damaged, or written by another version; each with the command that helps.
    """
    path = root / MANIFEST
    try:
        text = path.read_text(encoding="utf-8")
    except (FileNotFoundError, NotADirectoryError):
        raise SimError(_why_missing(root)) from None
    except UnicodeDecodeError:
        raise _damaged(path) from None
    try:
        data = json.loads(text)
        if data["format"] != FORMAT_VERSION:
            raise SimError(_other_format(root, data["format"]))
        if data.pop("checksum") != _digest(data):
            raise _damaged(path)
        settings = _settings(root, data["settings"])
        records = {
            (split, index): Record(checksum, redraws)
            for split in SPLITS
            for index, (checksum, redraws) in enumerate(
                zip(data["splits"][split]["checksums"], data["splits"][split]["redraws"], strict=True)
            )
        }
        facts = {name: data[name] for name in ("versions", "camera", "classes")}
        manifest = Manifest(settings, facts, records, data["fingerprint"])
    except (ValueError, KeyError, TypeError, AttributeError):
        raise _damaged(path) from None
    if list(records) != keys(settings):
        raise _damaged(path)
    return manifest


def write_manifest(root: Path, manifest: Manifest) -> None:
    """Writes the manifest atomically; from then on the folder counts as finished."""
    settings = manifest.settings
    data: dict[str, Any] = {
        "format": FORMAT_VERSION,
        "fingerprint": manifest.fingerprint,
        "content": manifest.content,
        "settings": settings.model_dump(mode="json"),
        **manifest.facts,
        "arrays": {name: {"dtype": f.dtype, "dims": ["N", *f.dims]} for name, f in FIELDS.items()},
        "splits": {
            split: {
                "trajectories": count,
                "redraws_total": sum(manifest.records[split, i].redraws for i in range(count)),
                "redraws": [manifest.records[split, i].redraws for i in range(count)],
                "checksums": [manifest.records[split, i].checksum for i in range(count)],
            }
            for split, count in counts(settings).items()
        },
    }
    data["checksum"] = _digest(data)
    write_at_once(root / MANIFEST, json.dumps(data, indent=1) + "\n")


class Journal:
    """`trajectories.jsonl`: a first line with settings and facts, then one line per finished trajectory.

    One process writes it, under the folder's lock. Trajectories with unreadable lines are generated again.
    """

    def __init__(self, root: Path, settings: Settings, facts: Facts, records: Mapping[Key, Record]) -> None:
        """Writes a new journal, replacing an old one."""
        self.path = root / JOURNAL
        head = {"format": FORMAT_VERSION, "settings": settings.model_dump(mode="json"), **facts}
        order = [key for key in keys(settings) if key in records]
        lines = [json.dumps(head), *(_line(key, records[key]) for key in order)]
        write_at_once(self.path, "".join(f"{line}\n" for line in lines))
        self.file = os.open(self.path, os.O_WRONLY | os.O_APPEND)

    def append(self, key: Key, record: Record) -> None:
        """Records that a trajectory's bytes have been written."""
        line = (_line(key, record) + "\n").encode()
        if os.write(self.file, line) != len(line):  # a disk that fills up accepts a part of the line
            os.write(self.file, b"\n")

    def close(self) -> None:
        """Closes the file."""
        os.close(self.file)


def read_journal(root: Path) -> tuple[Settings, Facts, dict[Key, Record]] | None:
    """Settings, facts and finished trajectories of a folder's journal; None if there is no journal.

    Raises:
        SimError: its first line is damaged or was written by another version.
    """
    path = root / JOURNAL
    if not path.exists():
        return None
    head, *lines = path.read_bytes().split(b"\n")
    try:
        data = json.loads(head)
        if data["format"] != FORMAT_VERSION:
            raise SimError(_other_format(root, data["format"]))
        settings = _settings(root, data["settings"])
        facts = {name: data[name] for name in ("versions", "camera", "classes")}
    except (ValueError, KeyError, TypeError):
        raise SimError(f"the first line of {path} is damaged: delete {root} and generate the data again") from None
    known = set(keys(settings))
    records = {}
    for line in lines:
        try:
            entry = json.loads(line)
            key, record = (entry["split"], entry["index"]), Record(entry["checksum"], entry["redraws"])
            if key in known:
                records[key] = record
        except (ValueError, KeyError, TypeError):
            continue
    return settings, facts, records


def write_at_once(path: Path, text: str) -> None:
    """Writes a small file atomically and syncs it to the disk."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with open(draft, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)
    sync_folder(path.parent)


def sync_folder(path: Path) -> None:
    """Syncs a folder's entries to the disk."""
    folder = os.open(path, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def _line(key: Key, record: Record) -> str:
    return json.dumps({"split": key[0], "index": key[1], "checksum": record.checksum, "redraws": record.redraws})


def _digest(data: object) -> str:
    text = json.dumps(data, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _settings(root: Path, data: Any) -> Settings:
    try:
        return Settings.model_validate_json(json.dumps(data))
    except ValidationError:
        raise SimError(
            f"{root} was made by another version of this program (its settings are unknown here): "
            "generate the data again in another folder with python -m sims.p2d --out"
        ) from None


def _why_missing(root: Path) -> str:
    found = read_journal(root) if root.is_dir() else None
    if found is None:
        return f"no P2D data at {root}: make them with python -m sims.p2d --out {root}"
    made, wanted = len(found[2]), len(keys(found[0]))
    return f"{root} is not finished ({made} of {wanted} trajectories made): resume with python -m sims.p2d --out {root}"


def _other_format(root: Path, found: object) -> str:
    return (
        f"{root} was written in format {found!r} and this program reads format {FORMAT_VERSION}: "
        "generate the data again in another folder with python -m sims.p2d --out"
    )


def _damaged(path: Path) -> DamagedManifestError:
    return DamagedManifestError(f"{path} is damaged: repair it with python -m sims.p2d verify {path.parent} --repair")
