"""`python -m apex_lab.report`: from run folders to the file."""

from __future__ import annotations

import functools
import html
import json
import re
import resource
import statistics
import subprocess
import sys
from pathlib import Path

import pytest

from apex_lab.base.errors import UserError
from apex_lab.report import asked
from apex_lab.report.asked import slug, split, write
from apex_lab.report.assemble import configurations, reseeded
from apex_lab.runs.listed import Listed, listed
from apex_lab.tables import definition
from tests.conftest import REPOSITORY
from tests.report.runs_made import made, pictures

WORDS = ["model=apex,space", "scale=smoke", "seed=0,1,2,3"]


@functools.cache
def composed() -> tuple[Listed, ...]:
    """The jobs of `WORDS`; their folders are relative, so each test has its own."""
    return tuple(listed(WORDS))


@pytest.fixture
def jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Listed, ...]:
    """APEX: two seeds finished, one failed, one waiting; SPACE: one finished on other data, the others waiting.

    They are composed once for all tests; a test with other words composes its own.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        asked, "listed", lambda words, conf: [j.again() for j in composed()] if words == WORDS else listed(words, conf)
    )
    apex, space = composed()[:4], composed()[4:]
    made(apex[0], versions={"torch": "2.11.0"})
    made(apex[1])
    made(apex[2], "failed", "The loss is not finite.", steps=77, dirty=True)
    made(space[0], data_fingerprint="other data")
    pictures(apex[1].folder)
    return composed()


def text_of(path: Path) -> str:
    """The words of a page, without its style, script and tags."""
    page = re.sub(r"<(style|script)>.*?</\1>", " ", path.read_text(), flags=re.DOTALL)
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]*>", " ", page)))


def test_a_report_tells_what_is_there_what_failed_and_what_is_missing(jobs: tuple[Listed, ...]) -> None:
    path = write(WORDS)
    assert path == Path("outputs/reports/model=apex,space_scale=smoke_seed=0,1,2,3/report.html")
    text = text_of(path)
    assert "8 runs in 2 configurations 3 finished 4 waiting 1 failed 2.0 hours of training" in text
    assert "Not paper scale: smoke." in text
    assert "5 of 8 runs are not finished" in text
    assert "Runs on p2d, scale smoke, saw 2 versions of the data." in text
    failure = "APEX, seed 2 failed at step 77: The loss is not finite. python -m apex_lab.train model=apex scale=smoke"
    assert f"{failure} seed=2" in text
    assert "APEX : seed 3 never started python -m apex_lab.train model=apex scale=smoke seed=3" in text
    assert "SPACE : seeds 1–3 never started python -m apex_lab.train model=space scale=smoke seed=1,2,3 -m" in text
    assert "python -m apex_lab.report model=apex,space scale=smoke seed=0,1,2,3" in text
    assert (
        "python -m apex_lab.train model=apex,space scale=smoke seed=0,1,2,3 hydra.sweeper.retry_failed=true -m" in text
    )
    assert "torch 2.13.0 (3); 2.11.0 (1)" in text
    assert "c0ffee (3 runs); c0ffee with changes that are in no commit (1 run)" in text


def test_tables_hold_our_values_beside_the_papers(jobs: tuple[Listed, ...]) -> None:
    values = [
        json.loads((job.folder / "metrics.json").read_text())["splits"]["test"]["total"]["ari_fg"] for job in jobs[:2]
    ]
    mean, deviation = statistics.mean(values), statistics.stdev(values)
    assert f"{mean:.2f} ± {deviation:.2f} (paper 0.89 ± 0.02)" in text_of(write(WORDS))


def test_pictures_are_of_the_first_finished_seed_that_has_some(jobs: tuple[Listed, ...]) -> None:
    page = write(WORDS).read_text()
    assert "APEX, seed 1</h3>" in page
    assert page.count("data:image/png;base64,") == 1
    assert page.count("data:video/mp4;base64,") == 1
    page = write([*WORDS, "videos=false", "folder=here"]).read_text()
    assert page.count("data:video/mp4;base64,") == 0
    assert "No movies were asked for" in page


def test_what_finds_no_room_is_named(jobs: tuple[Listed, ...]) -> None:
    path = write([*WORDS, "megabytes=0", "folder=small"])
    assert path == Path("small/report.html")
    assert "data:image/png;base64,iVB" not in path.read_text()
    text = text_of(path)
    assert f"{jobs[1].folder}/view/film_strip.png: no room" in text
    assert f"{jobs[1].folder}/view/movie.mp4: no room" in text


def test_reading_changes_no_run(jobs: tuple[Listed, ...]) -> None:
    before = {file: file.stat().st_mtime_ns for file in Path("outputs").rglob("*")}
    write([*WORDS, "folder=elsewhere"])
    after = {file: file.stat().st_mtime_ns for file in Path("outputs").rglob("*")}
    assert after == before


def test_damaged_runs_are_told_and_break_nothing(jobs: tuple[Listed, ...]) -> None:
    (jobs[0].folder / "run.json").write_text("{")
    (jobs[1].folder / "metrics.json").write_text("[]")
    (jobs[4].folder / "curves.csv").write_bytes(b"\xff\xfe")
    text = text_of(write(WORDS))
    assert "APEX, seed 0 damaged" in text
    assert "run.json cannot be read" in text


def test_runs_of_no_table_have_a_report_all_the_same(jobs: tuple[Listed, ...]) -> None:
    text = text_of(write([*WORDS, "tables=[3]", "model=space"]))
    assert "None of these jobs has a row in table 3" in text
    assert "SPACE" in text


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("megabytes=-1", "megabytes = -1 is wrong: input should be greater than or equal to 0."),
        ("megabytes=many", "megabytes = 'many' is wrong: input should be a valid number."),
        ("videos=maybe", "videos = 'maybe' is wrong"),
        ("folder=", "folder = '' is wrong"),
        ("folder=[", "'folder=\\[' cannot be read as key=value"),
    ],
)
def test_impossible_values_are_refused_in_a_sentence(word: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        split([word])


def test_words_of_the_report_of_tables_and_of_runs_are_told_apart() -> None:
    own, of_tables, rest = split(["+sweep=a", "megabytes=3", "tables=[1]", "folder=x", "dry_run=true", "seed=0,1"])
    assert (own.folder, own.videos, own.megabytes) == ("x", True, 3)
    assert of_tables == ["tables=[1]"]
    assert rest == ["+sweep=a", "dry_run=true", "seed=0,1"]


def test_without_a_model_a_report_is_of_all_runs_of_the_paper(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[list[str]] = []

    def noted(words: list[str], config_dir: str | None) -> list[Listed]:
        given.append(words)
        raise UserError("enough")

    monkeypatch.setattr(asked, "listed", noted)
    for words in (["scale=cpu"], ["+ablation=no_entropy"], ["+sweep=tracking"]):
        with pytest.raises(UserError, match="enough"):
            write(words)
    assert given == [["+sweep=paper", "scale=cpu"], ["+ablation=no_entropy"], ["+sweep=tracking"]]


def test_words_name_the_folder() -> None:
    assert slug(["+sweep=ablations", "scale=cpu", "paths.outputs=/x/y"]) == "ablations_scale=cpu"
    assert slug(["model=../../x", "seed=0"]) == "model=..-..-x_seed=0"
    assert slug(["paths.outputs=/x"]) == "runs"
    assert len(slug([f"model={'x' * 500}"])) == 100


def test_a_job_for_other_seeds() -> None:
    assert reseeded(["model=apex", "seed=0", "scale=cpu"], [3, 1]) == ["model=apex", "seed=1,3", "scale=cpu", "-m"]
    assert reseeded(["model=apex"], [0]) == ["model=apex", "seed=0"]


def test_labels_tell_configurations_apart() -> None:
    first = composed()[0]

    def job(change: str, **choices: str) -> Listed:
        return Listed((f"optimizer.lr={change}",), first.raw, {**first.choices, **choices}, change * 64, first.state)

    def labels(*jobs: Listed) -> list[str]:
        return [row.label for row in configurations(jobs, definition.load())]

    assert labels(job("1"), job("2", ablation="no_entropy")) == ["APEX", "APEX, No entropy loss"]
    assert labels(job("1"), job("2")) == ["APEX, optimizer.lr=1", "APEX, optimizer.lr=2"]
    assert labels(job("1"), job("2", data="sprites")) == ["APEX, p2d", "APEX, sprites"]
    assert labels(job("1", model="mine", experiment="x")) == ["mine, experiment=x"]


@pytest.mark.slow
def test_two_thousand_runs_take_less_than_five_seconds_and_no_pytorch(tmp_path: Path) -> None:
    words = ["+sweep=ablations", "scale=cpu", "seed=range(0,200)", f"paths.outputs={tmp_path}"]
    jobs = listed(words)
    assert len(jobs) == 2000
    for job in jobs:
        made(job)
    pictures(jobs[0].folder)
    program = (
        "import sys; from apex_lab.report.asked import write; write(sys.argv[1:]);"
        "heavy = {'torch', 'pandas', 'matplotlib', 'lightning'} & {*sys.modules}; assert not heavy, heavy"
    )
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", program, *words, f"folder={tmp_path / 'report'}"], cwd=REPOSITORY, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 5
    assert (tmp_path / "report" / "report.html").stat().st_size < 10_000_000
