"""What a recording shall hold: its kind, settings and arrays. Equal plans have equal fingerprints."""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from recordings.layout import FORMAT_VERSION, Field, Layout
from recordings.readme import readme

if TYPE_CHECKING:
    from recordings.manifest import Manifest

S = TypeVar("S")
"""Type of a kind's settings: a dict, or a class of its own."""

Facts = dict[str, Any]
"""`versions` (name -> version of everything besides the settings that determines bytes), and whatever else readers
should know: JSON data."""


@dataclass(frozen=True)
class Item:
    """One item: its arrays by field, and the notes that journal and manifest keep about it (JSON values)."""

    arrays: Mapping[str, object]
    notes: Mapping[str, Any] = field(default_factory=dict)


class Maker(ABC):
    """Makes items in worker processes. It is pickled, so its class must stand in a module that can be imported."""

    def facts(self) -> Facts:
        """Called once in every worker, before its first item.

        Raises:
            RecordingError: items cannot be made here.
        """
        return {"versions": {}}

    @abstractmethod
    def make(self, split: str, index: int) -> Item:
        """The i-th item of a split: a function of the arguments and of what has been pickled alone.

        Raises:
            RecordingError: it cannot be made; the work ends with this sentence, finished items are kept.
        """


@dataclass(frozen=True)
class Kind(Generic[S]):
    """What recordings of one kind have in common. A subclass has settings of its own type.

    Attributes:
        name: in sentences and in the manifest.
        make_command: shell command that makes a folder or resumes it; "{root}" stands for it.
        repair_command: likewise, repairs a finished one.
        version: raised when the same settings give other bytes.
        item, items: noun and plural; the journal is called "<items>.jsonl".
        notes: names of the notes of every item.
        totals: those of them whose sums per split stand in the manifest.
        about: paragraph of the folder's README.
        describes_itself: whether fingerprint, manifest and journal hold the kind's name, its version and the layout;
            False for kinds whose settings determine the layout.
    """

    name: str
    make_command: str
    repair_command: str
    version: int = 1
    item: str = "item"
    items: str = "items"
    notes: tuple[str, ...] = ()
    totals: tuple[str, ...] = ()
    about: str = ""
    describes_itself: bool = True

    @property
    def journal(self) -> str:
        """File name of the journal."""
        return f"{self.items}.jsonl"

    def parse(self, data: dict[str, Any]) -> S:
        """Settings from JSON data; `ValueError` if they are not settings of this version."""
        if not isinstance(data, dict):
            raise ValueError("settings are a dict")
        return data  # type: ignore[return-value]

    def dump(self, settings: S) -> dict[str, Any]:
        """Settings as JSON data."""
        plain: dict[str, Any] = json.loads(json.dumps(settings))
        return plain

    def identity(self, settings: S) -> dict[str, Any]:
        """What the fingerprint covers besides format, settings and layout."""
        return {"kind": self.name, "version": self.version}

    def layout(self, settings: S, stored: Mapping[str, Any]) -> Layout:
        """The layout of a folder with these settings whose manifest or journal has the entries `stored`.

        Raises:
            ValueError, KeyError, TypeError: no layout is stored there.
        """
        return layout_from(stored)

    def readme(self, manifest: Manifest[S]) -> str:
        """The README.md of a finished folder."""
        return readme(manifest)


@dataclass(frozen=True)
class Plan(Generic[S]):
    """What a folder shall hold.

    Attributes:
        kind: its kind.
        settings: everything else that determines the bytes, as JSON data or the kind's own type.
        layout: the arrays and the number of items per split.
    """

    kind: Kind[S]
    settings: S
    layout: Layout

    @property
    def fingerprint(self) -> str:
        """16 hex digits over format, kind, version, settings and layout.

        Package versions are in the manifest instead (`facts["versions"]`), because prepared data must be found by their
        settings on machines that cannot make them too.
        """
        wish = {
            "format": FORMAT_VERSION,
            **self.kind.identity(self.settings),
            "settings": self.kind.dump(self.settings),
        }
        return digest({**wish, **stored_layout(self, meanings=False)})[:16]

    def difference(self, other: Plan[S]) -> str | None:
        """The first thing in which this plan (there) differs from another (here), in words; None for equal ones."""
        here, there = self.kind.dump(other.settings), self.kind.dump(self.settings)
        for name in dict.fromkeys([*there, *here]):
            if name not in here or name not in there or here[name] != there[name]:
                old, new = (repr(data[name]) if name in data else "missing" for data in (there, here))
                return f"{name} is {old} there and {new} here"
        for split in dict.fromkeys([*self.layout.counts, *other.layout.counts]):
            before, now = self.layout.counts.get(split, 0), other.layout.counts.get(split, 0)
            if before != now:
                return f"{split} has {before} {self.kind.items} there and {now} here"
        same = stored_layout(self, meanings=False) == stored_layout(other, meanings=False)
        return None if same else "its arrays have other types or shapes"


def stored_layout(plan: Plan[S], *, meanings: bool = True) -> dict[str, Any]:
    """The layout as a manifest and, without meanings, a fingerprint hold it; empty where the settings determine it."""
    if not plan.kind.describes_itself:
        return {}
    layout = plan.layout
    return {
        "sizes": dict(layout.sizes),
        "arrays": described(layout, meanings=meanings),
        "counts": dict(layout.counts),
    }


def described(layout: Layout, *, meanings: bool) -> dict[str, Any]:
    """Type, shape and, if asked for, meaning of every array as JSON data; "N" is the number of items."""
    return {
        name: {"dtype": f.dtype, "dims": ["N", *f.dims], **({"meaning": f.meaning} if meanings else {})}
        for name, f in layout.fields.items()
    }


def layout_from(data: Mapping[str, Any]) -> Layout:
    """The inverse of `stored_layout`; `ValueError`, `KeyError`, `TypeError` for anything else."""
    fields = {name: Field(f["dtype"], tuple(f["dims"][1:]), f["meaning"]) for name, f in data["arrays"].items()}
    layout = Layout(fields, data["counts"], data["sizes"])
    numbers = [*layout.counts.values(), *(size for name in fields for size in layout.shape(name))]
    if not all(isinstance(number, int) and number >= 0 for number in numbers):
        raise ValueError("sizes are numbers from 0 on")
    return layout


def digest(data: object) -> str:
    """32 hex digits that are equal only for equal JSON data."""
    text = json.dumps(data, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
