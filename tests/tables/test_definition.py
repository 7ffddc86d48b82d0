"""The files of sweeps/tables/: the paper's rows, columns and numbers, and what is refused."""

from __future__ import annotations

import pkgutil
import shutil
from pathlib import Path

import pytest
import yaml

from apex_lab.base.errors import UserError
from apex_lab.config.composition import conf_dir
from apex_lab.metrics import KEYS
from apex_lab.tables import definition as spec
from apex_lab.tables.definition import Table

SPECIFICATION = spec.load()


def table(number: int) -> Table:
    return next(table for table in SPECIFICATION.tables if table.number == number)


def labels(number: int) -> list[str]:
    return [SPECIFICATION.label(row) for section in table(number).sections for row in section.rows]


def test_rows_and_columns_of_the_paper() -> None:
    assert [table.number for table in SPECIFICATION.tables] == [1, 2, 3, 4]
    assert labels(1) == ["OP3", "SCALOR", "G-SWM", "SPACE", "Slot-Att.", "APEX"]
    assert labels(2) == ["OP3", "SCALOR", "G-SWM", "APEX"]
    assert labels(3) == [
        "APEX",
        "Image space STN",
        "No entropy loss",
        "SCALOR-norm",
        "Gaussian likelihood",
        "Gaussian likelihood & SCALOR-norm",
    ]
    assert labels(4) == ["SPACE", "SCALOR", "G-SWM", "APEX"]
    headings = {number: " ".join(column.label for column in table(number).columns) for number in (1, 2, 3, 4)}
    assert headings == {
        1: "Object tracking ARI-FG MSC-FG ARI MSC",
        2: "MOTA MOTP Match ID S. FPs Miss MD MT",
        3: "ARI-FG MSC-FG ARI MSC",
        4: "Two objects Three objects Four objects",
    }
    tracking = [SPECIFICATION.models[row.model].tracking for section in table(1).sections for row in section.rows]
    assert tracking == [True, True, True, False, False, True]
    assert [row.fails for section in table(3).sections for row in section.rows] == [False] * 4 + [True] * 2


def test_columns_are_keys_of_the_evaluation_with_its_directions() -> None:
    for number in (1, 2, 3):
        for column in table(number).columns:
            if column.key != "tracking":
                assert KEYS[column.key].better == column.better
    variant = table(2).variant
    assert variant is not None
    assert all(column.key + variant.suffix in KEYS for column in table(2).columns)


def test_published_tracking_values_obey_the_identities_up_to_rounding() -> None:
    for section in table(2).sections:
        for row in section.rows:
            value = {key: mean for key, (mean, _) in row.published.items()}
            assert value["match"] - value["fps"] == pytest.approx(value["mota"], abs=0.11)
            assert value["match"] + value["id_switches"] + value["misses"] == pytest.approx(100, abs=0.21)
            assert value["md"] < value["mt"]  # as printed: the headings are exchanged


def test_our_md_stands_beside_the_paper_s_mt() -> None:
    columns = {column.key: column.published_as for column in table(2).columns}
    assert (columns.pop("md"), columns.pop("mt")) == ("mt", "md")
    assert set(columns.values()) == {None}


def test_models_of_this_version_track_as_the_tables_say() -> None:
    found = {}
    for file in (conf_dir() / "model").glob("*.yaml"):
        target = yaml.safe_load(file.read_text())["model"]["_target_"]
        found[file.stem] = pkgutil.resolve_name(target).tracks
    assert found == {name: SPECIFICATION.models[name].tracking for name in found}


def test_every_row_but_yardsticks_has_every_published_value() -> None:
    for each in SPECIFICATION.tables:
        keys = {column.key for column in each.columns} - {"tracking"}
        assert all(set(row.published) == keys for section in each.sections for row in section.rows)
    assert all(not row.published for section in SPECIFICATION.yardsticks for row in section.rows)


def test_the_same_model_has_the_same_published_values_in_two_tables() -> None:
    first, third = (table(number).sections for number in (1, 3))
    assert first[0].rows[-1].published == third[0].rows[0].published


@pytest.mark.parametrize(
    ("file", "old", "new", "told"),
    [
        (
            "1_segmentation.yaml",
            "model: op3",
            "model: opp3",
            "1_segmentation.yaml: model 'opp3' is not in models.yaml.",
        ),
        (
            "1_segmentation.yaml",
            "decimals: 2",
            "decimals: 2\ndecimal: 2",
            "Unknown key 1_segmentation.yaml.decimal = 2",
        ),
        ("1_segmentation.yaml", "better: up", "better: upp", "1_segmentation.yaml.columns.1.better = 'upp' is wrong"),
        ("3_ablation.yaml", "{ari_fg: [0.89", "{ari_gf: [0.89", "has a published value for 'ari_gf'"),
        ("4_arrangement.yaml", "number: 4", "number: [", "4_arrangement.yaml cannot be read"),
        ("models.yaml", "tracking: true", "tracking: 7", "models.yaml.models.op3.tracking = 7 is wrong"),
        ("yardsticks.yaml", "model: oracle", "model: orakle", "yardsticks.yaml: model 'orakle'"),
    ],
)
def test_wrong_files_are_refused(file: str, old: str, new: str, told: str, tmp_path: Path) -> None:
    folder = tmp_path / "tables"
    shutil.copytree(spec.folder(), folder)
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new, 1))
    with pytest.raises(UserError) as error:
        spec.load(folder)
    assert told in str(error.value)
    assert "\n" not in str(error.value)
