"""Checks of a finished P2D folder against its manifest: a cheap one for every start, a full one over all bytes."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from sims.errors import SimError
from sims.p2d.manifest import MANIFEST, Manifest, Record, difference, fingerprint, read_manifest, write_at_once
from sims.p2d.progress import progress
from sims.p2d.settings import Settings
from sims.p2d.store import (
    FIELDS,
    HEADER_BYTES,
    SPLITS,
    Arrays,
    Key,
    array_bytes,
    array_path,
    header,
    item_bytes,
    keys,
)

VERIFIED = ".verified.json"


@dataclass
class Damage:
    """Result of a full check: sentences about damaged files, trajectories with a wrong checksum."""

    files: list[str] = field(default_factory=list)
    trajectories: list[Key] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(self.files or self.trajectories)

    def lines(self) -> list[str]:
        """One line per finding; trajectories as `train/3` or, in a row, `train/3-17`."""
        return self.files + [f"trajectory {name}: bytes do not match the checksum" for name in _runs(self.trajectories)]


def check(root: Path, settings: Settings | None = None, splits: Iterable[str] = SPLITS) -> Manifest:
    """The cheap check: manifest, format, files' presence, sizes and headers. Reads no data.

    Args:
        root: the folder.
        settings: the settings that the data must have; None: any.
        splits: the splits whose files are checked.

    Raises:
        SimError: with the first problem and the command that fixes it.
    """
    manifest = read_manifest(root)
    if settings is not None and manifest.fingerprint != fingerprint(settings):
        what = difference(manifest.settings, settings) or "another version of the simulation made them"
        raise SimError(f"{root} holds data with other settings ({what}): choose another folder or delete this one")
    found = [line for split in splits for line in _file_damage(root, split, manifest.settings)]
    if found:
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        raise SimError(f"{found[0]}{more}: repair it with python -m sims.p2d verify {root} --repair")
    return manifest


def verify(root: Path, manifest: Manifest, *, shown: bool = True) -> Damage:
    """The full check: every trajectory's bytes against its checksum, on all cores.

    Without damage, it records the state of the files in the folder, so that `is_verified` can detect later changes.
    """
    settings = manifest.settings
    before = _state(root, manifest)
    damage = Damage([line for split in SPLITS for line in _file_damage(root, split, settings)])
    damage.trajectories = mismatches(root, settings, manifest.records, shown=shown)
    if not damage:
        _note(root / VERIFIED, before)
    return damage


def note_verified(root: Path, manifest: Manifest) -> None:
    """Records that all bytes have just been verified."""
    _note(root / VERIFIED, _state(root, manifest))


def is_verified(root: Path, manifest: Manifest) -> bool:
    """True if a full check found no damage and no file has been touched since (size, times, inode)."""
    try:
        noted = json.loads((root / VERIFIED).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return noted == _state(root, manifest)


def mismatches(root: Path, settings: Settings, records: dict[Key, Record], *, shown: bool) -> list[Key]:
    """The recorded trajectories whose bytes on the disk do not have the recorded checksum."""
    wanted = [key for key in keys(settings) if key in records]
    bad: list[Key] = []
    volume = sum(item_bytes(settings, name) for name in FIELDS)
    shown = shown and len(wanted) * volume > 1e9  # a smaller check is too quick for a progress bar
    with (
        ThreadPoolExecutor(os.cpu_count()) as threads,
        progress(f"checking {root.name}", len(wanted), "trajectories", shown=shown) as advance,
    ):
        for split in SPLITS:
            part = [key for key in wanted if key[0] == split]
            try:
                arrays = Arrays(root, split, settings)
            except OSError:  # a file is missing, and with it all its trajectories
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


def _file_damage(root: Path, split: str, settings: Settings) -> list[str]:
    found = []
    for name in FIELDS:
        path, size = array_path(root, split, name), array_bytes(settings, split, name)
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
        elif head != header(settings, split, name):
            found.append(f"{path} has a damaged header")
    return found


def _state(root: Path, manifest: Manifest) -> dict[str, Any]:
    """State that changes when a file is touched; unlike the modification time, users cannot set the change time."""
    files: dict[str, list[int] | None] = {}
    for path in [root / MANIFEST, *(array_path(root, split, name) for split in SPLITS for name in FIELDS)]:
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
    """Names of trajectories, with consecutive ones joined into ranges."""
    names: list[str] = []
    start: Key | None = None
    for (split, index), following in pairwise([*found, ("", -1)]):
        start = start or (split, index)
        if following != (split, index + 1):
            names.append(f"{split}/{start[1]}" if start[1] == index else f"{split}/{start[1]}-{index}")
            start = None
    return names
