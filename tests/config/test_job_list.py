"""The jobs of a command line: products, and lists in conf/sweep/."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from apex_lab.base.errors import UserError
from apex_lab.config.composition import composed, composing, conf_dir
from apex_lab.config.job_list import Words, expand, sweeps, tables_of


@pytest.fixture
def hydra() -> Iterator[None]:
    with composing([]):
        yield


def listed(folder: Path, files: dict[str, str], *words: str) -> list[Words]:
    """The jobs of a command that finds further sweep files in a folder."""
    (folder / "sweep").mkdir()
    for name, text in files.items():
        (folder / "sweep" / f"{name}.yaml").write_text(text)
    with composing(words):
        return expand(words, [f"hydra.searchpath=[file://{folder}]"])


@pytest.mark.usefixtures("hydra")
def test_a_product_runs_its_last_key_fastest() -> None:
    assert expand(["seed=0,1", "model.grid=range(4,9,4)", "scale=cpu"]) == [
        ("seed=0", "model.grid=4", "scale=cpu"),
        ("seed=0", "model.grid=8", "scale=cpu"),
        ("seed=1", "model.grid=4", "scale=cpu"),
        ("seed=1", "model.grid=8", "scale=cpu"),
    ]


@pytest.mark.usefixtures("hydra")
def test_words_for_hydra_are_no_part_of_a_job() -> None:
    words = ["hydra/launcher=basic", "seed=1", "++hydra.job.name=x", "hydra.mode=MULTIRUN", "~callbacks.progress"]
    assert expand(words) == [("seed=1", "~callbacks.progress")]


@pytest.mark.usefixtures("hydra")
def test_an_interval_is_refused() -> None:
    with pytest.raises(UserError, match=r"lr=interval\(1e-4,1e-2\) is an interval, .* search by apex_lab\.tune"):
        expand(["optimizer.lr=interval(1e-4,1e-2)"])


@pytest.mark.usefixtures("hydra")
@pytest.mark.parametrize(
    ("sweep", "number"), [("segmentation", 28), ("tracking", 20), ("ablations", 28), ("arrangement", 7), ("paper", 55)]
)
def test_the_paper_s_sweeps(sweep: str, number: int) -> None:
    jobs = expand([f"+sweep={sweep}", "scale=smoke"])
    # paper: 6 models and 5 ablations x 4 seeds, 4 classical methods, 7 jobs of the arrangement task
    assert len(jobs) == number
    assert all(job[-1] == "scale=smoke" for job in jobs)
    assert len({(made.choices["model"], made.raw["seed"]) for made in composed("train", jobs[:4])}) == 4


@pytest.mark.usefixtures("hydra")
def test_the_command_s_words_replace_those_of_the_list() -> None:
    assert expand(["+sweep=arrangement", "seed=1,2", "model=apex"]) == [
        ("data=arrangement", "seed=1", "model=apex"),
        ("data=arrangement", "seed=2", "model=apex"),
    ]
    assert len(expand(["+sweep=ablations", "+ablation=gaussian", "seed=0", "model=apex"])) == 1


def test_a_sweep_is_a_union_of_products(tmp_path: Path) -> None:
    files = {
        "mine": "jobs: [{model: apex, +ablation: [gaussian, no_entropy], seed: 0}]\ninclude: [more]",
        "more": "jobs: [{model: op3, seed: [0, 1], data.frames: null}, {model: apex, +ablation: gaussian, seed: 0}]",
    }
    assert listed(tmp_path, files, "+sweep=mine") == [
        ("model=apex", "+ablation=gaussian", "seed=0"),
        ("model=apex", "+ablation=no_entropy", "seed=0"),
        ("model=op3", "seed=0", "data.frames=null"),
        ("model=op3", "seed=1", "data.frames=null"),
    ]


EXCEPTIONS = """
jobs: [{model: [apex, space], seed: [0, 1]}]
exceptions:
  - {where: {model: [space, op3], data: p2d, scale: cpu}, set: {+tuned: space, seed: 7}}
  - {where: {scale: smoke}, set: {seed: [8, 9]}}
"""


@pytest.mark.parametrize(
    ("words", "jobs"),
    [
        # the paper's scale is the usual one, p2d the usual data
        ((), ["model=apex seed=0", "model=apex seed=1", "model=space seed=0", "model=space seed=1"]),
        (
            ("scale=cpu,smoke", "seed=3"),
            [
                *("model=apex seed=3 scale=cpu", "model=apex seed=3 scale=smoke"),
                *("model=space +tuned=space seed=3 scale=cpu", "model=space seed=3 scale=smoke"),
            ],
        ),
        (
            ("scale=cpu", "data=sprites", "model=space"),
            [f"model=space seed={n} data=sprites scale=cpu" for n in (0, 1)],
        ),
        (("scale=cpu", "model=op3"), ["model=op3 seed=7 +tuned=space scale=cpu"]),
        (("scale=cpu", "model=op3", "+tuned=sigma"), ["model=op3 seed=7 +tuned=sigma scale=cpu"]),
        (("scale=smoke", "model=op3"), ["model=op3 seed=8 scale=smoke", "model=op3 seed=9 scale=smoke"]),
    ],
)
def test_exceptions_hold_where_they_say(words: Words, jobs: list[str], tmp_path: Path) -> None:
    found = listed(tmp_path, {"mine": EXCEPTIONS}, "+sweep=mine", *words)
    assert sorted(map(sorted, found)) == sorted(sorted(job.split()) for job in jobs)


@pytest.mark.usefixtures("hydra")
@pytest.mark.parametrize("sweep", ["segmentation", "tracking"])
def test_on_a_cpu_baselines_have_two_seeds_and_tuned_values(sweep: str) -> None:
    """Each in `conf/tuned/` that is named after a model of the sweep: that is how a baseline's search is called."""
    assert not any("tuned" in word for job in expand([f"+sweep={sweep}", "scale=paper"]) for word in job)
    jobs = expand([f"+sweep={sweep}", "scale=cpu"])
    models = {word.removeprefix("model=") for job in jobs for word in job if word.startswith("model=")}
    for model in models - {"color_clusters", "background_subtraction", "oracle", "one_segment"}:
        words = [job for job in jobs if f"model={model}" in job]
        tuned = (f"+tuned={model}",) if (conf_dir() / "tuned" / f"{model}.yaml").is_file() else ()
        assert {frozenset(job) for job in words} == {
            frozenset((f"model={model}", f"seed={seed}", "scale=cpu", *tuned))
            for seed in range(4 if model == "apex" else 2)
        }


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("include: [mine]", r"conf/sweep/mine\.yaml includes itself \(mine > mine\)"),
        ("jobs: []", r"conf/sweep/mine\.yaml lists no jobs"),
        ("jobs: {model: apex}", r"mine\.yaml\.jobs = "),
        ("job: [{model: apex}]", r"Unknown key .*job"),
        ("jobs: [{model: {_target_: os.system}}]", r"jobs\.0\.model"),
        ("{jobs: [{seed: 0}], exceptions: [{where: {modell: a}, set: {}}]}", r"Unknown key .*where\.modell = 'a'"),
        ("{jobs: [{seed: 0}], exceptions: [{where: {}, set: {+model._target_: os.system}}]}", r"os\.system"),
    ],
)
def test_faulty_sweep_files(text: str, told: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=told):
        listed(tmp_path, {"mine": text}, "+sweep=mine")


def test_a_sweep_that_is_not_there() -> None:
    with pytest.raises(UserError, match="sweep=ablation"), composing(["+sweep=ablation"]):
        expand(["+sweep=ablation"])


def test_seeds_share_a_composition() -> None:
    words = [("model=apex", f"seed={seed}", "scale=smoke") for seed in (0, 5, 7)]
    with composing([]):
        made = list(composed("train", words))
    assert [one.raw["seed"] for one in made] == [0, 5, 7]
    assert [one.words for one in made] == words
    assert {key for key in made[0].raw if made[0].raw[key] != made[2].raw[key]} == {"seed"}


@pytest.mark.usefixtures("hydra")
def test_sweeps_name_their_tables(tmp_path: Path) -> None:
    assert sweeps(["+sweep=paper,tracking", "seed=0"]) == ["paper", "tracking"]
    assert sweeps(["seed=0"]) == []
    assert tables_of(["tracking", "segmentation"]) == [1, 2]
    assert tables_of(["paper"]) == [1, 2, 3, 4]
    (tmp_path / "sweep").mkdir()
    (tmp_path / "sweep" / "mine.yaml").write_text("include: [tracking]\n")
    assert tables_of(["mine", "tracking"], [f"hydra.searchpath=[file://{tmp_path}]"]) is None
