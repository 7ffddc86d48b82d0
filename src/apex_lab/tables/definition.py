"""Which runs make which table, and what the paper has there: the files of sweeps/tables/, read and checked."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field

import apex_lab
from apex_lab.base.errors import UserError
from apex_lab.base.validation import one_line, sentence, validate

DATA = "p2d"
"""What the paper's tables of scores were made from."""

Published = tuple[float, float]
"""Mean and standard deviation as the paper prints them."""


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class Model(_Part):
    """What the tables call a model, and whether it keeps identities over time."""

    label: str
    latex: str | None = None
    tracking: bool


class Column(_Part):
    """A column: `key` is a key of the results, or `tracking` (yes or no, from the model).

    `published_as` is the key of the column under whose heading the paper prints these values, where it is another.
    """

    key: str
    label: str
    better: Literal["up", "down"] | None = None
    published_as: str | None = None


class Row(_Part):
    """A model, or an ablation of it.

    `fails`: the paper marks it as failing; no candidate for bold. `published_excluded`: how many failed seeds the paper
    left out. `expected`: values that the row must have, else the evaluation is wrong.
    """

    model: str
    ablation: str | None = None
    label: str | None = None
    latex: str | None = None
    fails: bool = False
    published: dict[str, Published] = Field(default_factory=dict)
    published_excluded: int = Field(default=0, ge=0)
    expected: dict[str, float] = Field(default_factory=dict)

    @property
    def run(self) -> tuple[str, str | None]:
        """The words that name its runs."""
        return self.model, self.ablation


class Section(_Part):
    """Rows between two rules; `candidates`: whether they compete for bold."""

    title: str | None = None
    candidates: bool = True
    rows: tuple[Row, ...]


class Variant(_Part):
    """The same table from other keys: every key with a suffix."""

    number: str
    caption: str
    suffix: str


class Table(_Part):
    """One table of the paper.

    `source`: metrics.json or arrangement.json of the runs. `data`: the paper's for this table; rows of other data say
    so. `seeds`: where it needs fewer than its jobs have.
    """

    number: int
    caption: str
    source: Literal["metrics", "arrangement"]
    data: str = DATA
    decimals: int = Field(ge=0)
    arrows: bool
    yardsticks: bool
    seeds: tuple[int, ...] | None = None
    columns: tuple[Column, ...]
    sections: tuple[Section, ...]
    published_notes: tuple[str, ...] = ()
    variant: Variant | None = None


class Specification(_Part):
    """All tables in their order, the rows below them, and the models they name."""

    models: dict[str, Model]
    tables: tuple[Table, ...]
    yardsticks: tuple[Section, ...]

    def sections(self, table: Table, yardsticks: bool) -> tuple[Section, ...]:
        """The rows of a table, with or without those below its last rule."""
        return table.sections + (self.yardsticks if yardsticks and table.yardsticks else ())

    @property
    def rows(self) -> set[tuple[str, str | None]]:
        """Models and ablations that stand in any table."""
        sections = [section for table in self.tables for section in self.sections(table, yardsticks=True)]
        return {row.run for section in sections for row in section.rows}

    def label(self, row: Row) -> str:
        """The label of a row; a model that the tables do not know has its word."""
        if row.label is not None:
            return row.label
        model = self.models[row.model].label if row.model in self.models else row.model
        return f"{model}, ablation={row.ablation}" if row.ablation else model

    def latex(self, row: Row) -> str | None:
        """The label in LaTeX, where that differs."""
        if row.label is not None:
            return row.latex
        return self.models[row.model].latex if row.model in self.models and not row.ablation else None


class _Models(_Part):
    models: dict[str, Model]


class _Sections(_Part):
    sections: tuple[Section, ...]


def folder() -> Path:
    """The folder of the tables' files: inside the installed package, else the repository's.

    Raises:
        UserError: neither is there (a damaged installation).
    """
    package = Path(apex_lab.__file__).resolve().parent
    for place in (package / "sweeps" / "tables", package.parent.parent / "sweeps" / "tables"):
        if (place / "models.yaml").is_file():
            return place
    raise UserError(f"No descriptions of tables at {package / 'sweeps' / 'tables'}: install apex_lab again.")


def load(place: Path | None = None) -> Specification:
    """Reads the specification; `place` is the folder where it lies (default: `folder`).

    Raises:
        UserError: a file cannot be read, or holds an impossible value; one sentence.
    """
    place = place or folder()
    models = validate(_Models, {"models": _read(place / "models.yaml")}, "models.yaml")
    below = validate(_Sections, {"sections": _read(place / "yardsticks.yaml")}, "yardsticks.yaml")
    assert isinstance(models, _Models)
    assert isinstance(below, _Sections)
    tables = []
    for file in sorted(place.glob("[0-9]*.yaml")):
        content = _read(file)
        table = validate(Table, content if isinstance(content, dict) else {"": content}, file.name)
        assert isinstance(table, Table)
        _check(table.sections, [column.key for column in table.columns], models.models, file.name)
        tables.append(table)
    _check(below.sections, None, models.models, "yardsticks.yaml")
    return Specification(models=models.models, tables=tuple(tables), yardsticks=below.sections)


def _read(file: Path) -> Any:
    try:
        return yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise UserError(sentence(f"{file} cannot be read: {one_line(error)}")) from error


def _check(
    sections: Iterable[Section], columns: Collection[str] | None, models: Mapping[str, Model], name: str
) -> None:
    """Names that must be known: models, and the columns of published values."""
    for row in (row for section in sections for row in section.rows):
        if row.model not in models:
            raise UserError(f"{name}: model '{row.model}' is not in models.yaml.")
        for key in row.published:
            if columns is not None and key not in columns:
                raise UserError(
                    f"{name}: the row of {row.model} has a published value for '{key}', which no column has."
                )
