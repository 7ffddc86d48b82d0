"""Where a configuration's runs lie, without PyTorch: the name of its folder, and runs that older versions named.

outputs/<model>[_<ablation>][_tuned_<study>]_<data>_<scale>_<hash>/seed_<n>/
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml

from apex_lab.base.errors import UserError
from apex_lab.base.order import natural_key
from apex_lab.config.upgrades import FORMAT, fingerprint, upgraded
from apex_lab.runs.record import read_record
from apex_lab.runs.state import RECORD

NAMING = ("model", "ablation", "tuned", "data", "scale")
"""Groups whose choice stands in a folder's name, in their order."""


def group_name(identity: str, choices: Mapping[str, str]) -> str:
    """Name of a configuration, common to all its seeds.

    Args:
        identity: its fingerprint.
        choices: group -> the word chosen for it.
    """
    return f"{_words(choices)}_{identity[:8]}"


def run_folder(outputs: Outputs, identity: str, choices: Mapping[str, str], seed: object) -> Path:
    """Where a run lies: the folder of its name, or one of an older version with the same identity.

    Args:
        outputs: the folder of runs; one for many runs lists and reads what older versions named once.
        identity: fingerprint of the configuration.
        choices: group -> the word chosen for it.
        seed: of the run.
    """
    named = outputs.folder / group_name(identity, choices) / f"seed_{seed}"
    if named.exists():
        return named
    return outputs.older(_words(choices), identity, f"seed_{seed}") or named


def with_same_words(outputs: Path, choices: Mapping[str, str], seed: object) -> list[Path]:
    """Folders of a seed whose names have the words of some choices, whatever their hash.

    Args:
        outputs: the folder of runs; need not exist.
        choices: group -> the word chosen for it.
        seed: of the runs.
    """
    named = re.compile(rf"{re.escape(_words(choices))}_[0-9a-f]{{8}}")
    try:
        names = sorted(os.listdir(outputs))
    except OSError:
        return []
    return [outputs / name / f"seed_{seed}" for name in names if named.fullmatch(name)]


def seed_folders(outputs: Path) -> list[Path]:
    """Every folder of a run, by name in natural order and then by seed; none where `outputs` does not exist.

    Raises:
        UserError: it cannot be listed.
    """
    if not outputs.exists():
        return []
    found = []
    try:
        for group in os.scandir(outputs):
            if group.is_dir():
                seeds = [(int(each.name[5:]), each) for each in os.scandir(group.path) if _is_seed(each)]
                found += [(natural_key(group.name), seed, Path(each.path)) for seed, each in seeds]
    except OSError as error:
        raise UserError(
            f"paths.outputs = {outputs} cannot be read ({error.strerror}): give a folder of runs."
        ) from error
    return [path for _, _, path in sorted(found)]


def _is_seed(entry: os.DirEntry[str]) -> bool:
    return re.fullmatch(r"seed_(0|[1-9]\d*)", entry.name) is not None and entry.is_dir()


def _words(choices: Mapping[str, str]) -> str:
    named = {group: choices.get(group) for group in NAMING}
    return "_".join(f"tuned_{word}" if group == "tuned" else word for group, word in named.items() if word)


class Outputs:
    """A folder of runs. Folders that older versions named are listed and read once, however many runs are looked for.

    Args:
        folder: `paths.outputs`.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._read: dict[tuple[str, str], dict[str, Path]] = {}
        self._upgraded: dict[tuple[Path, int, str], str | None] = {}

    def older(self, words: str, identity: str, seed: str) -> Path | None:
        """The run of a configuration in a folder whose name has another hash; None where there is none.

        Args:
            words: of the folder's name, without the hash.
            identity: fingerprint of the configuration.
            seed: name of the run's folder.
        """
        if (words, seed) not in self._read:
            self._read[words, seed] = self._identities(words, seed)
        return self._read[words, seed].get(identity)

    @cached_property
    def _names(self) -> list[str]:
        try:
            return sorted(os.listdir(self.folder))
        except OSError:
            return []

    def _identities(self, words: str, seed: str) -> dict[str, Path]:
        """Fingerprint as this version computes it -> folder."""
        found: dict[str, Path] = {}
        for name in self._names:
            if re.fullmatch(rf"{re.escape(words)}_[0-9a-f]{{8}}", name):
                folder = self.folder / name / seed
                for identity in self._stored(folder) if folder.is_dir() else ():
                    found.setdefault(identity, folder)
        return found

    def _stored(self, folder: Path) -> list[str]:
        """The identities that a run folder may stand for; none where it cannot be recognised."""
        try:
            record = read_record(folder / RECORD)
        except UserError:
            record, formats = {}, list(range(1, FORMAT + 1))  # lost or damaged; the configuration still tells
        else:
            format = record.get("format", 1)
            if format == FORMAT:  # begun by an older version, resumed by this one
                return [str(record.get("fingerprint"))]
            formats = [format] if isinstance(format, int) and 1 <= format < FORMAT else []
        return [found for format in formats if (found := self._of_format(folder, format, record)) is not None]

    def _of_format(self, folder: Path, format: int, record: Mapping[str, Any]) -> str | None:
        """The fingerprint of a stored configuration; seeds of one folder with one recorded fingerprint share it."""
        recorded = record.get("fingerprint")
        key = (folder.parent if recorded is not None else folder, format, str(recorded))
        if key not in self._upgraded:
            self._upgraded[key] = _upgraded_fingerprint(folder, format)
        return self._upgraded[key]


def _upgraded_fingerprint(folder: Path, format: int) -> str | None:
    """The identity of a folder's configuration, read as one of a given format; None where it is not."""
    try:
        return fingerprint(upgraded(stored_configuration(folder), format))
    except (OSError, yaml.YAMLError, LookupError, TypeError, AttributeError, ValueError, RecursionError):
        return None


def stored_configuration(folder: Path) -> Any:
    """Content of a run's config.yaml, by the fast reader where PyYAML has it.

    Raises:
        OSError, ValueError, YAMLError: it cannot be read.
    """
    text = (folder / "config.yaml").read_text(encoding="utf-8")
    if hasattr(yaml, "CSafeLoader"):
        return yaml.load(text, yaml.CSafeLoader)
    return yaml.safe_load(text)
