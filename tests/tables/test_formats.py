"""Markdown, LaTeX, JSON and CSV of the same tables."""

from __future__ import annotations

import csv
import io
import json
import re
import shutil
import statistics
import subprocess
from pathlib import Path
from typing import Any

import pytest

from apex_lab.base.files import write_json
from apex_lab.tables import latex, markdown
from apex_lab.tables import output_files as export
from apex_lab.tables.build import Built
from apex_lab.tables.missing_runs import Command
from tests.tables.folders import made, run_folder

VALUES = (0.1234567890123, 0.2, 0.9)


@pytest.fixture
def outputs(tmp_path: Path) -> Path:
    """Runs with everything that can go wrong."""
    for seed, value in enumerate(VALUES):
        run_folder(tmp_path, "gswm", seed, {"ari": value, "motp": None}, foreground_share=0.3 if seed else 0.0)
    run_folder(tmp_path, "apex", 0, {"ari": 0.5})
    (run_folder(tmp_path, "apex", 1) / "run.json").write_text("{ & % $ # _ } ~ ^ \\ ü 木")
    run_folder(
        tmp_path, "scalor", 0, status="failed", reason="--a < b > c | \"d\" 'e' 100 % of $x_1^2$ ~ ü ß 木 \x07 {é}"
    )
    folder = run_folder(tmp_path, "apex", 2)
    (folder / "arrangement.json").write_text('{"distances_m": {"2": [[0.1, 0.3], [0.5, null]]}}')
    return tmp_path


def everything(outputs: Path) -> tuple[tuple[Built, ...], tuple[Command, ...]]:
    return made(outputs, tables=(1, 2, 3, 4), published=True, yardsticks=True)


def test_markdown_has_a_cell_for_every_column(outputs: Path) -> None:
    tables, commands = everything(outputs)
    text = markdown.document(tables, True, commands)
    for table in tables:
        part = markdown.table_text(table, True)
        assert part in text
        counts = {len(re.findall(r"(?<!\\)\|", row)) for row in part.splitlines() if row.startswith("|")}
        assert counts == {len(table.columns) + 3}
        assert len({len(row) for row in part.splitlines() if row.startswith("|")}) == 1
    assert all(command.text in text for command in commands)
    assert all(sign not in text for sign in ("nan", "None"))


def test_latex_is_well_formed(outputs: Path) -> None:
    tables, commands = everything(outputs)
    text = latex.document(tables, True, commands)
    code = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
    assert text.isascii()
    assert re.sub(r"\\[{}]", "", code).count("{") == re.sub(r"\\[{}]", "", code).count("}")
    assert len(re.findall(r"(?<!\\)\$", code)) % 2 == 0
    assert re.findall(r"\\begin\{(\w+)", code).count("table") == len(tables) == 5
    opened: list[str] = []
    for kind, name in re.findall(r"\\(begin|end)\{(\w+)\}", code):
        if kind == "begin":
            opened.append(name)
        else:
            assert opened.pop() == name
    assert opened == []
    for table, body in zip(tables, re.findall(r"\\begin\{tabular\}(.*?)\\end\{tabular\}", code, re.S), strict=True):
        assert body.startswith(f"{{l{'c' * (len(table.columns) + 1)}}}\n\\toprule\n")
        assert body.endswith("\\bottomrule\n")
        rows = [row for row in body.splitlines() if row.endswith("\\\\") and "multicolumn" not in row]
        assert len(rows) == len(table.lines) + 1
        assert all(len(re.findall(r"(?<!\\)&", row)) == len(table.columns) + 1 for row in rows)
        assert body.count(r"\midrule") == len(table.blocks)
    assert r"\textsc{g-swm}* & \yes & " in code
    assert r"$\mathbf{80.0\pm 0.0}$ \published{$83.2\pm 0.6$}" in code
    assert "% python -m apex_lab.train model=op3 seed=0,1,2,3 scale=paper -m # OP3" in text


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("50 % of a_b & {c} #1 $", r"50 \% of a\_b \& \{c\} \#1 $\mathdollar$"),
        ("a\\b ~ ^", r"a\textbackslash{}b \textasciitilde{} \textasciicircum{}"),
        ("1 < 2 > 0 | 3", "1 $<$ 2 $>$ 0 $|$ 3"),
        ("--config-dir ---", "-{}-config-dir -{}-{}-"),
        ("1 ± 2 — é ß 木\x07", r"1 $\pm$ 2 --- e ? ? "),
        ('"MT"', "''MT''"),
    ],
)
def test_text_in_latex(text: str, told: str) -> None:
    assert latex.escape(text) == told


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed")
def test_latex_compiles(outputs: Path, tmp_path: Path) -> None:
    tables, commands = everything(outputs)
    (tmp_path / "tables.tex").write_text(latex.document(tables, True, commands))
    words = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "tables.tex"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, errors="replace", timeout=120)
    assert done.returncode == 0, done.stdout[-2000:]


def as_json(outputs: Path) -> dict[str, Any]:
    tables, commands = everything(outputs)
    write_json(outputs / "tables.json", export.as_json(tables, commands))
    return json.loads((outputs / "tables.json").read_text())


def row(found: dict[str, Any], table: int, model: str) -> dict[str, Any]:
    return next(row for row in found["tables"][table]["rows"] if row["model"] == model)


def test_json_keeps_unrounded_values_per_seed_and_the_table_over_all_seeds(outputs: Path) -> None:
    found = as_json(outputs)
    assert found["ddof"] == 1
    gswm = row(found, 0, "gswm")
    cell = gswm["cells"]["ari"]
    assert cell["per_seed"] == {"0": VALUES[0], "1": VALUES[1], "2": VALUES[2]}
    assert (cell["n"], cell["ddof"], cell["mean"]) == (2, 1, pytest.approx(0.55))
    assert cell["std"] == pytest.approx(statistics.stdev(VALUES[1:]))
    assert cell["over_all_seeds"]["n"] == 3
    assert cell["over_all_seeds"]["mean"] == pytest.approx(statistics.fmean(VALUES))
    assert cell["over_all_seeds"]["std"] == pytest.approx(statistics.stdev(VALUES))
    assert gswm["seeds"]["counted"] == [1, 2]
    assert list(gswm["seeds"]["excluded"]) == ["0"]
    assert cell["published"] == {"mean": 0.33, "std": 0.13, "printed_as": "ari"}
    motp = row(found, 1, "gswm")["cells"]["motp"]
    assert (motp["n"], motp["mean"], motp["std"]) == (0, None, None)
    assert motp["per_seed"] == {"0": None, "1": None, "2": None}


def test_json_says_under_which_heading_the_paper_prints_a_value(outputs: Path) -> None:
    cells = row(as_json(outputs), 1, "apex")["cells"]
    assert cells["md"]["published"] == {"mean": 71.2, "std": 0.7, "printed_as": "mt"}
    assert cells["mt"]["published"] == {"mean": 70.8, "std": 1.0, "printed_as": "md"}


def test_json_keeps_every_scenario(outputs: Path) -> None:
    cell = row(as_json(outputs), 4, "apex")["cells"]["2"]
    assert cell["values"] == {"2": [pytest.approx(0.2), 0.5]}
    assert (cell["n"], cell["mean"]) == (2, pytest.approx(0.35))


def test_csv_has_a_line_per_row_and_column(outputs: Path) -> None:
    tables, _ = everything(outputs)
    for table in tables:
        lines = list(csv.DictReader(io.StringIO(export.as_csv(table))))
        assert len(lines) == len(table.lines) * len([column for column in table.columns if column.better])
    found = list(csv.DictReader(io.StringIO(export.as_csv(tables[0]))))
    ari = next(line for line in found if line["model"] == "gswm" and line["key"] == "ari")
    assert [float(ari[f"seed_{seed}"]) for seed in range(3)] == list(VALUES)
    assert float(ari["std"]) == pytest.approx(statistics.stdev(VALUES[1:]))
    assert (ari["n"], ari["ddof"], ari["counted_seeds"], ari["excluded_seeds"]) == ("2", "1", "1 2", "0")
    assert (ari["published_mean"], ari["published_std"], ari["better"]) == ("0.33", "0.13", "up")
    missing = next(line for line in found if line["model"] == "op3")
    assert (missing["mean"], missing["std"], missing["n"], missing["text"]) == ("", "", "0", "—")
