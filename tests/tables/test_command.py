"""`python -m apex_lab.tables` from its first to its last word."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from apex_lab.runs.listed import Listed, listed
from apex_lab.tables.asked import asked, read_tables
from tests.conftest import TINY, Ended
from tests.tables.folders import run_folder


@pytest.fixture
def tables(command: Callable[..., Ended]) -> Callable[..., Ended]:
    return lambda *words: command("tables", *words)


def write(job: Listed, **scores: float) -> Path:
    """The finished run of a job, in its folder."""
    outputs, hash8 = job.folder.parent.parent, job.folder.parent.name[-8:]
    named = {group: job.choices.get(group) for group in ("ablation", "data", "scale")}
    more = {"fingerprint": job.fingerprint, "format": 2}
    return run_folder(outputs, job.choices["model"], job.seed, dict(scores), hash8=hash8, **named, **more)


def test_without_words_every_table_of_the_paper(tables: Callable[..., Ended], tmp_path: Path) -> None:
    ended = tables("dry_run=true")
    assert (ended.code, ended.err) == (0, "")
    for number in ("1", "2", "2b", "3", "4"):
        assert f"## Table {number}\n" in ended.out
    assert "python -m apex_lab.train +sweep=paper -m " in ended.out
    assert ended.out.count("python -m apex_lab.train model=") == 22
    assert "python -m apex_lab.train model=scalor seed=0,1,2,3 -m " in ended.out
    assert "python -m apex_lab.train model=apex +ablation=no_entropy seed=0,1,2,3 -m " in ended.out
    assert "scale=" not in ended.out
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "numbers"),
    [
        (("+sweep=arrangement", "model=apex"), ["4"]),
        (("+sweep=arrangement,arrangement", "model=apex,space", "tables=[1,2]", "-m"), ["1", "2", "2b"]),
    ],
)
def test_a_sweep_names_its_tables(words: tuple[str, ...], numbers: list[str], tables: Callable[..., Ended]) -> None:
    ended = tables(*words, "dry_run=true")
    assert (ended.code, ended.err) == (0, "")
    assert [row.removeprefix("## Table ") for row in ended.out.splitlines() if row.startswith("## Table")] == numbers


def test_without_a_sweep_a_model_chooses_among_the_papers_runs(tables: Callable[..., Ended], tmp_path: Path) -> None:
    ended = tables("model=op3,one_segment", "scale=cpu")
    assert (ended.code, ended.err) == (0, "")
    trained = [line.split()[3] for line in ended.out.splitlines() if line.startswith("python -m apex_lab.train")]
    assert trained == ["model=op3", "model=one_segment"]  # and no command that runs the whole sweep
    assert (tmp_path / "outputs" / "tables" / "paper_op3_one_segment_p2d_cpu" / "table_1.csv").exists()


def test_a_model_that_the_paper_does_not_have_is_taken_as_it_is_given(tables: Callable[..., Ended]) -> None:
    ended = tables("model=tiny", "data=squares", "scale=smoke", *TINY[:2], "dry_run=true")
    assert ended.err == "None of these jobs has a row in a table: model=tiny data=squares scale=smoke.\n"


@pytest.fixture
def own(tmp_path: Path) -> str:
    """A folder with two sweeps: `mine`, two seeds of one model, and `two`, two models at scale=cpu."""
    folder = tmp_path / "own"
    (folder / "sweep").mkdir(parents=True)
    (folder / "sweep" / "mine.yaml").write_text("tables: [1]\njobs: [{model: color_clusters, seed: [0, 1]}]\n")
    (folder / "sweep" / "two.yaml").write_text("jobs: [{model: [space, oracle], seed: 5, scale: cpu}]\n")
    return str(folder)


def test_a_sweep_of_one_s_own_makes_all_tables_of_scores_with_the_rows_that_are_in_it(
    tables: Callable[..., Ended], own: str
) -> None:
    ended = tables("+sweep=two", "--config-dir", own)
    assert (ended.code, ended.err) == (0, "")
    rows = [row.split("|")[1].strip() for row in ended.out.splitlines() if row.startswith("| ")]
    assert [row for row in rows if row and not row.startswith(("---", "*"))] == [
        *("SPACE, scale=cpu", "Oracle, scale=cpu"),  # table 1
        *("Oracle, scale=cpu",) * 3,  # tables 2, 2b and 3
    ]
    assert ended.out.splitlines()[-1] == "outputs/tables/two_p2d_cpu/table_3.csv"


def test_tables_are_printed_stored_and_their_paths_told(
    tables: Callable[..., Ended], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own: str
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ("+sweep=mine", "scale=cpu", "seed=0,1,2,3", "paths.outputs='my runs'")
    for job in listed(words, own)[:2]:
        write(job, ari=0.5 + 0.1 * job.seed)
    ended = tables(*words, "trainer.log_interval=7", "--config-dir", own)  # which changes no result
    assert (ended.code, ended.err) == (0, "")
    assert "0.55 ± 0.07" in ended.out
    assert "- Colour" not in ended.out  # nothing is to be said of it
    words_of_jobs = "scale=cpu seed=2,3 'paths.outputs='\"'\"'my runs'\"'\"'' trainer.log_interval=7"
    found = f"python -m apex_lab.train model=color_clusters {words_of_jobs} --config-dir {own} -m "
    assert found in ended.out
    folder = Path("my runs") / "tables" / "mine_p2d_cpu"
    names = ["tables.md", "tables.tex", "tables.json", "table_1.csv"]
    assert ended.out.splitlines()[-4:] == [str(folder / name) for name in names]
    assert (folder / "tables.md").read_text() in ended.out
    stored = json.loads((folder / "tables.json").read_text())
    assert [table["number"] for table in stored["tables"]] == ["1"]
    assert stored["asked"]["words"] == [*words, "trainer.log_interval=7"]
    assert stored["tables"][0]["rows"][0]["label"] == "Colour clusters, scale=cpu"
    assert stored["made_by"]["versions"]["apex_lab"]


def test_values_that_a_configuration_has_anyway_make_the_same_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("apex_lab.config.preflight.check_training", lambda *_: None)  # which takes long
    words = ["+sweep=mine", "scale=cpu", "seed=0"]
    (job,) = asked(words, own).jobs
    frames = job.raw["data"]["frames"]
    write(job, ari=0.5)
    (line,) = read_tables([*words, f"data.frames={frames}"], own).tables[0].lines
    assert (line.label, line.seeds) == ("Colour clusters, scale=cpu", "1")
    (line,) = read_tables([*words, f"data.frames={frames + 1}"], own).tables[0].lines
    assert (line.label, line.seeds) == (f"Colour clusters, scale=cpu, data.frames={frames + 1}", "0 of 1")
    folder = asked([*words, f"data.frames={frames + 1}"], own).folder
    assert folder == Path("outputs") / "tables" / f"mine_p2d_cpu_data.frames={frames + 1}"


def test_the_same_runs_give_the_same_bytes(
    tables: Callable[..., Ended], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("apex_lab.runs.provenance.commit", lambda: ("0" * 40, False))
    words = ("+sweep=arrangement", "tables=[1]", "model=apex")
    write(listed([words[0], words[2]])[0])
    for name in ("one", "two"):
        assert tables(*words, f"folder={name}").code == 0
    one, two = ({file.name: file.read_text() for file in (tmp_path / name).iterdir()} for name in ("one", "two"))
    two["tables.json"] = two["tables.json"].replace('"folder": "two"', '"folder": "one"')
    assert one == two


def test_damaged_files_are_told_and_do_not_stop_anything(
    tables: Callable[..., Ended], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ("+sweep=arrangement", "model=apex")
    damaged = write(listed(words)[0]) / "metrics.json"
    damaged.write_text("")
    ended = tables(*words, "dry_run=true", "tables=[1]")
    assert ended.code == 0
    assert f"- APEX, data=arrangement: seed 0 failed: {damaged} cannot be read" in ended.out


SMALL = ("+sweep=arrangement", "model=oracle", "tables=[1]")
REFUSED = {
    "tables=[5]": "tables = [5] is wrong: there are 1, 2, 3, 4.",
    "tables=[]": "tables = [] is wrong",
    "seeds=[0,1]": "seeds=[0,1]: the seeds of a row are those of its jobs; write seed=0,1 for two of them.",
    "exclude_failed=[gswn]": "exclude_failed: there is no model 'gswn' in op3, scalor, gswm",
    "arrangement_mean=median": "arrangement_mean = 'median' is wrong: input should be 'scenario' or 'object'.",
    "++publish=true": "Unknown key publish=true; did you mean 'published'?",
    "scale=cpuu": "did you mean 'cpu'?",
    "data.frame=3": "Unknown key data.frame = 3; did you mean 'frames'?",
    "trainer.max_steps=many": "trainer.max_steps = 'many' is wrong",
    "--tables": "unrecognized arguments: --tables.",
}


@pytest.mark.parametrize("word", REFUSED)
def test_refuses_before_anything_is_written(word: str, tables: Callable[..., Ended], tmp_path: Path) -> None:
    ended = tables(*SMALL, word)
    assert (ended.code, ended.out) == (2, "")
    assert REFUSED[word] in ended.err
    assert len(ended.err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_table_in_which_no_job_has_a_row(tables: Callable[..., Ended]) -> None:
    ended = tables("+sweep=arrangement", "model=space", "tables=[3]")
    assert (ended.code, ended.out) == (2, "")
    assert ended.err == "None of these jobs has a row in table 3: +sweep=arrangement model=space.\n"


def test_a_folder_that_cannot_be_written(tables: Callable[..., Ended], tmp_path: Path) -> None:
    (tmp_path / "outputs").write_text("")
    ended = tables(*SMALL)
    assert ended.code == 1
    assert "cannot be written (Not a directory)" in ended.err
    assert "Traceback" not in ended.err


def test_it_imports_no_pytorch() -> None:
    code = "import sys, apex_lab.tables.asked; sys.exit('torch' in sys.modules or 'scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0
