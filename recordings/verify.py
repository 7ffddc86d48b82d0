"""Checks of a finished recording against its manifest: a cheap one for every start, a full one over all bytes."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from recordings.errors import RecordingError
from recordings.files import Arrays, write_at_once
from recordings.layout import HEADER_BYTES, Key, Layout, array_path
from recordings.manifest import MANIFEST, Manifest, Record, journal_matches, read_manifest
from recordings.plan import Kind, Plan, S
from recordings.progress import progress

VERIFIED = ".verified.json"


@dataclass
class Damage:
    """Result of a full check: sentences about damaged files, items with a wrong checksum, and their noun."""

    files: list[str] = field(default_factory=list)
    items: list[Key] = field(default_factory=list)
    noun: str = "item"

    def __bool__(self) -> bool:
        return bool(self.files or self.items)

    def lines(self) -> list[str]:
        """One line per finding; items as `train/3` or, in a row, `train/3-17`."""
        return self.files + [f"{self.noun} {name}: bytes do not match the checksum" for name in _runs(self.items)]


def check(root: Path, kind: Kind[S], plan: Plan[S] | None = None, splits: Iterable[str] | None = None) -> Manifest[S]:
    """The cheap check: manifest, format, files' presence, sizes and headers. Reads no data.

    Args:
        root: the folder.
        kind: of the recording.
        plan: what the folder must hold; None: anything of that kind.
        splits: the splits whose files are checked; None: all.

    Raises:
        RecordingError: with the first problem and the command that fixes it.
    """
    manifest = read_manifest(root, kind)
    if plan is not None and manifest.fingerprint != plan.fingerprint:
        what = manifest.plan.difference(plan) or "another version of the program made them"
        raise RecordingError(
            f"{root} holds data with other settings ({what}): choose another folder or delete this one"
        )
    found = [
        line
        for split in (manifest.layout.splits if splits is None else splits)
        for line in _file_damage(root, split, manifest.layout)
    ]
    if found:
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        raise RecordingError(f"{found[0]}{more}: repair it with {kind.repair_command.format(root=root)}")
    return manifest


def verify(root: Path, manifest: Manifest[S], *, shown: bool = True) -> Damage:
    """The full check: every item's bytes against its checksum, on all cores, and the journal against the manifest.

    Without damage, it records the state of the files in the folder, so that `is_verified` can detect later changes.
    """
    layout, kind = manifest.layout, manifest.plan.kind
    before = _state(root, manifest)
    damage = Damage([line for split in layout.splits for line in _file_damage(root, split, layout)], noun=kind.item)
    if not journal_matches(root, manifest):
        damage.files.append(f"{root / kind.journal} is missing or damaged")
    damage.items = mismatches(root, manifest.plan, manifest.records, shown=shown)
    if not damage:
        _note(root / VERIFIED, before)
    return damage


def note_verified(root: Path, manifest: Manifest[S]) -> None:
    """Records that all bytes have just been verified."""
    _note(root / VERIFIED, _state(root, manifest))


def is_verified(root: Path, manifest: Manifest[S]) -> bool:
    """True if a full check found no damage and no file has been touched since (size, times, inode)."""
    try:
        noted = json.loads((root / VERIFIED).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return bool(noted == _state(root, manifest))


def mismatches(root: Path, plan: Plan[S], records: Mapping[Key, Record], *, shown: bool) -> list[Key]:
    """The recorded items whose bytes on the disk do not have the recorded checksum."""
    layout = plan.layout
    wanted = [key for key in layout.all_keys() if key in records]
    bad: list[Key] = []
    volume = sum(layout.item_bytes(name) for name in layout.fields)
    shown = shown and len(wanted) * volume > 1e9  # a smaller check is too quick for a progress bar
    with (
        ThreadPoolExecutor(os.cpu_count()) as threads,
        progress(f"checking {root.name}", len(wanted), plan.kind.items, shown=shown) as advance,
    ):
        for split in layout.splits:
            part = [key for key in wanted if key[0] == split]
            try:
                arrays = Arrays(root, split, layout)
            except OSError:  # a file is missing, and with it all its items
                bad += part
                continue
            try:
                for key, found in zip(part, threads.map(_checksum, [arrays] * len(part), part), strict=True):
                    advance(1)
                    if found != records[key].checksum:
                        bad.append(key)
            finally:
                arrays.close()
    return bad


def _checksum(arrays: Arrays, key: Key) -> str | None:
    try:
        return arrays.checksum(key[1])
    except OSError:  # the disk cannot read it
        return None


def _file_damage(root: Path, split: str, layout: Layout) -> list[str]:
    found = []
    for name in layout.fields:
        path, size = array_path(root, split, name), layout.array_bytes(split, name)
        try:
            there = path.stat().st_size
            with open(path, "rb") as file:
                head = file.read(HEADER_BYTES)
        except FileNotFoundError:
            found.append(f"{path} is missing")
            continue
        except OSError as error:
            found.append(f"{path} cannot be read ({error.strerror})")
            continue
        if there < size:
            found.append(f"{path} is truncated ({there} of {size} bytes)")
        elif there > size:
            found.append(f"{path} is too long ({there} bytes, not {size})")
        elif head != layout.header(split, name):
            found.append(f"{path} has a damaged header")
    return found


def _state(root: Path, manifest: Manifest[S]) -> dict[str, Any]:
    """State that changes when a file is touched; unlike the modification time, users cannot set the change time."""
    layout = manifest.layout
    files: dict[str, list[int] | None] = {}
    arrays = [array_path(root, split, name) for split in layout.splits for name in layout.fields]
    for path in [root / MANIFEST, *arrays]:
        try:
            stat = path.stat()
            state = [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino]
        except OSError:
            files[str(path.relative_to(root))] = None
        else:
            files[str(path.relative_to(root))] = state
    return {"content": manifest.content, "files": files}


def _note(path: Path, state: dict[str, Any]) -> None:
    with suppress(OSError):  # without write permission, the data are checked again every time
        write_at_once(path, json.dumps(state, indent=1) + "\n")


def _runs(found: list[Key]) -> list[str]:
    """Names of items, with consecutive ones joined into ranges."""
    names: list[str] = []
    start: Key | None = None
    for (split, index), following in pairwise([*found, ("", -1)]):
        start = start or (split, index)
        if following != (split, index + 1):
            names.append(f"{split}/{start[1]}" if start[1] == index else f"{split}/{start[1]}-{index}")
            start = None
    return names
