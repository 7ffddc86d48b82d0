"""What runs were made with: code, data, versions, hardware, and how many of them with each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from apex_lab.report.contents import Configuration


class Counted(NamedTuple):
    """A fact that runs record, such as a version, and how many runs have each value."""

    name: str
    values: list[tuple[str, int]]


def facts(configurations: Sequence[Configuration]) -> dict[str, list[Counted]]:
    """What the runs were made with: "code and data", "versions", "hardware"; each fact with all its values."""
    found: dict[str, dict[str, Counter[str]]] = {"code and data": {}, "versions": {}, "hardware": {}}

    def count(part: str, name: str, value: object) -> None:
        if value is not None:
            found[part].setdefault(name, Counter())[str(value)] += 1

    for configuration in configurations:
        for seed in configuration.seeds:
            record = seed.state.record
            if record.get("commit"):
                changed = " with changes that are in no commit" if record.get("dirty") else ""
                count("code and data", "commit", f"{record['commit']}{changed}")
            if record.get("data_fingerprint"):
                data = configuration.choices.get("data", "")
                count("code and data", f"data {data}", f"fingerprint {record['data_fingerprint']}")
            for part in ("versions", "hardware"):
                content = record.get(part)
                for name, value in content.items() if isinstance(content, dict) else ():
                    count(part, str(name), value)
    return {
        part: [Counted(name, counts.most_common()) for name, counts in names.items()] for part, names in found.items()
    }
