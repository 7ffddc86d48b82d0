"""`python -m apex_lab.tune`: a study from its command to its plots and the tuned file, and what it refuses."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import optuna
import pytest
import yaml
from optuna.trial import TrialState

from apex_lab.base.files import read_json
from apex_lab.runs.identity import seed_folders
from apex_lab.tuning.storage import Journal
from tests.conftest import TINY, Ended

SWEPT = ("optimizer.lr=tag(log,interval(1e-3,2e-2))", "++model.width=int(interval(4,64))")


@pytest.fixture
def tune(command: Callable[..., Ended], tmp_path: Path) -> Callable[..., Ended]:
    """A study of the tiny model, whose tuned file goes into the test's folder."""
    return lambda *words: command("tune", *TINY, f"study.conf={tmp_path / 'conf'}", *words)


@pytest.fixture
def the_study(tmp_path: Path) -> Callable[[], optuna.Study]:
    """The only study in the only journal that the test has made."""

    def find() -> optuna.Study:
        (journal,) = (tmp_path / "outputs" / "studies").glob("*/journal.log")
        storage = Journal(journal, 15, lambda study, trial: None)
        (summary,) = optuna.get_all_study_summaries(storage)
        return optuna.load_study(study_name=summary.study_name, storage=storage)

    return find


@pytest.mark.slow
def test_a_study_from_command_to_tuned_run(
    tune: Callable[..., Ended], command: Callable[..., Ended], the_study: Callable[[], optuna.Study], tmp_path: Path
) -> None:
    asked = (*SWEPT, "study.name=small", "trainer.max_steps=3")
    ended = tune(*asked, "study.trials=1")
    assert ended.code == 0, ended.err
    ended = tune(*asked, "study.trials=2")  # the same study goes on
    assert ended.code == 0, ended.err
    assert "1 of 2 trials done" in ended.out
    trials = the_study().get_trials()
    assert [trial.state for trial in trials] == [TrialState.COMPLETE] * 2
    assert trials[0].params["optimizer.lr"] == 0.01  # the recipe's; model.width is set by no file
    for trial in trials:  # trials are ordinary runs, scored on validation videos alone
        (folder,) = (Path(name) for name in trial.user_attrs["folders"])
        scored = read_json(folder / "metrics.json")["splits"]
        assert list(scored) == ["val"]
        assert trial.values == [scored["val"]["total"]["ari_fg"]]
        assert trial.intermediate_values.keys() == {3}
        record = read_json(folder / "run.json")
        assert (record["status"], record["model"], record["seed"]) == ("finished", "tiny", 0)
        assert record["command"].startswith("python -m apex_lab.train ")
        stored = yaml.safe_load((folder / "config.yaml").read_text())
        assert stored["optimizer"]["lr"] == trial.params["optimizer.lr"]
        assert stored["model"]["width"] == trial.params["model.width"]
    studies = tmp_path / "outputs" / "studies" / "small"
    assert len(seed_folders(studies)) == 2
    assert not seed_folders(tmp_path / "outputs")  # they are not among ordinary runs
    for kind in ("history", "importance", "contour"):
        assert (studies / "plots" / f"{kind}.png").read_bytes().startswith(b"\x89PNG")
        page = (studies / "plots" / f"{kind}.html").read_text()
        assert "<script src=" not in page
        assert len(page) > 1_000_000  # with all of plotly.js inside

    best = max(trials, key=lambda trial: trial.values[0])
    text = (tmp_path / "conf" / "tuned" / "small.yaml").read_text()
    assert text == (studies / "conf" / "tuned" / "small.yaml").read_text()
    assert f"# Trial {best.number} of 2, seeds [0]: ari_fg" in text
    tuned = yaml.safe_load(text)
    assert tuned == {"optimizer": {"lr": best.params["optimizer.lr"]}, "model": {"width": best.params["model.width"]}}
    (tmp_path / "both" / "tuned").mkdir(parents=True)
    for name in ("model", "data", "recipe"):
        (tmp_path / "both" / name).symlink_to(Path(TINY[1]) / name)
    (tmp_path / "both" / "tuned" / "small.yaml").write_text(text)
    words = ["--config-dir", str(tmp_path / "both"), *TINY[2:], "trainer.max_steps=1", "+tuned=small"]
    ended = command("train", *words)
    assert ended.code == 0, ended.err
    (run,) = seed_folders(tmp_path / "outputs")
    assert run.parent.name.startswith("tiny_tuned_small_squares_smoke_")
    assert read_json(run / "run.json")["tuned"] == "small"
    stored = yaml.safe_load((run / "config.yaml").read_text())
    assert stored["optimizer"]["lr"] == best.params["optimizer.lr"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("optimizer.lr=interval(-0.1,0.1)",), "optimizer.lr = -0.1 is wrong"),  # an end
        (("clips.batch_size=interval(2,8)",), "clips.batch_size"),  # not int(...)
        (("model.components=choice(2,3,1)",), "leaves no room for an object"),  # the last of several choices
        (("model.componets=choice(2,3)",), "did you mean 'components'?"),
        (("optimizer.lr=interval(1e-3,1e-2)", "unsupervised=true"), "has no likelihood"),
        (("model=color_clusters", "~optimizer", "++model.x=choice(1,2)"), ""),
        (("+study=sigam",), "there is no such choice"),
        (("study=sigma",), "write +study=sigma"),
    ],
)
def test_every_end_and_choice_is_checked_before_the_first_trial(
    tune: Callable[..., Ended], tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    ended = tune(*words)
    assert ended.code == 2
    assert message in ended.err
    assert not (tmp_path / "outputs").exists()


def test_a_time_limit_of_runs_is_none_of_a_study(tune: Callable[..., Ended], tmp_path: Path) -> None:
    ended = tune("optimizer.lr=interval(1e-3,1e-2)", "trainer.max_minutes=5")
    assert ended.code == 2
    assert "trainer.max_minutes = 5 would end trials early: write study.max_minutes=5." in ended.err
    assert not (tmp_path / "outputs").exists()


@pytest.mark.slow
def test_seeds_are_averaged_and_a_second_objective_makes_a_front(
    tune: Callable[..., Ended], the_study: Callable[[], optuna.Study], tmp_path: Path
) -> None:
    ended = tune(SWEPT[0], "study.trials=3", "study.seeds=[0,5]", "study.objectives=[ari_fg,msc]")
    assert ended.code == 0, ended.err
    assert "no trial is pruned" in ended.out
    study = the_study()
    for trial in study.get_trials():
        assert len(trial.user_attrs["folders"]) == 2
        totals = [read_json(Path(f) / "metrics.json")["splits"]["val"]["total"] for f in trial.user_attrs["folders"]]
        assert trial.values == pytest.approx([sum(t[key] for t in totals) / 2 for key in ("ari_fg", "msc")])
    plots = next((tmp_path / "outputs" / "studies").glob("*/plots"))
    assert {path.stem for path in plots.iterdir()} == {
        f"{kind}_{name}" for kind in ("history", "importance") for name in ("ari_fg", "msc")
    }
    assert (tmp_path / "outputs" / "studies").is_dir()
    assert not (tmp_path / "conf").exists() or list((tmp_path / "conf" / "tuned").iterdir())


@pytest.mark.slow
def test_unsupervised_maximises_the_elbo(
    command: Callable[..., Ended], the_study: Callable[[], optuna.Study], tmp_path: Path
) -> None:
    """The shipped sigma study on APEX, without a label in the objective."""
    words = ("+study=sigma", "data=sprites", "scale=smoke", "unsupervised=true", "study.trials=2")
    ended = command("tune", *words, f"study.conf={tmp_path / 'conf'}")
    assert ended.code == 0, ended.err
    first, second = the_study().get_trials()
    assert first.params == {"model.likelihood.sigma_fg": 0.1, "model.likelihood.sigma_bg": 0.04}  # the paper's
    for trial in (first, second):
        terms = read_json(Path(trial.user_attrs["folders"][0]) / "metrics.json")["splits"]["val"]["terms"]
        elbo = -sum(terms[f"{name}"] for name in ("nll", "kl_what", "kl_where", "kl_pres", "kl_background"))
        assert trial.values == pytest.approx([elbo])
        config = yaml.safe_load((Path(trial.user_attrs["folders"][0]) / "config.yaml").read_text())
        assert config["schedule"]["sigma_fg_scale"]["start"] == 1.0
    (file,) = (tmp_path / "conf" / "tuned").iterdir()
    assert file.stem == the_study().study_name
    tuned = yaml.safe_load(file.read_text())
    assert tuned["schedule"] == {name: {"start": 1.0, "end": 1.0} for name in ("sigma_fg_scale", "sigma_bg_scale")}
    assert set(tuned["model"]["likelihood"]) == {"sigma_fg", "sigma_bg"}


@pytest.mark.slow
def test_hopeless_trials_are_pruned_and_failed_ones_do_not_end_the_study(
    tune: Callable[..., Ended], the_study: Callable[[], optuna.Study]
) -> None:
    """Rates of 1e30 diverge; with a threshold no score reaches, all others are pruned at the first validation."""
    words = (
        "optimizer.lr=choice(0.01,1e30)",
        "study/sampler=brute_force",
        "study/pruner=none",
        "study.pruner._target_=optuna.pruners.ThresholdPruner",
        "+study.pruner.lower=2.0",
        "trainer.validation_interval=2",
    )
    ended = tune(*words, "study.trials=2")
    assert ended.code == 1  # none completed
    trials = {trial.params["optimizer.lr"]: trial for trial in the_study().get_trials()}
    pruned, failed = trials[0.01], trials[1e30]
    assert pruned.state == TrialState.PRUNED
    assert list(pruned.intermediate_values) == [2]
    record = read_json(Path(pruned.user_attrs["folders"][0]) / "run.json")
    assert (record["outcome"], record["steps"]) == ("pruned", 2)
    assert "pruned at step 2" in record["reason"]
    assert failed.state == TrialState.FAIL
    assert "not finite" in failed.user_attrs["reason"]
    assert read_json(Path(failed.user_attrs["folders"][0]) / "run.json")["outcome"] == "diverged"
    assert "completed" in ended.err
    # both are over: the same command starts nothing
    again = tune(*words, "study.trials=2")
    assert again.code == 1
    assert "2 of 2 trials done" in again.out
    assert len(the_study().get_trials()) == 2


@pytest.mark.slow
def test_another_study_of_the_same_name_is_refused_and_its_tuned_file_stays(
    tune: Callable[..., Ended], tmp_path: Path
) -> None:
    words = ("study.trials=1", "trainer.max_steps=1", "study.name=mine")
    assert tune(SWEPT[0], *words).code == 0
    ended = tune("optimizer.lr=interval(1e-3,1e-2)", *words)
    assert ended.code == 1
    assert "study.name = 'mine' is another study (its parameters" in ended.err
    ended = tune(SWEPT[0], *words, "study.seeds=[1]")
    assert ended.code == 1
    assert "its seeds" in ended.err
    file = tmp_path / "conf" / "tuned" / "mine.yaml"
    before = file.read_text()
    file.write_text(before.replace("# Study: mine", "# Study: other"))
    ended = tune(SWEPT[0], *words)
    assert ended.code == 2
    assert "mine.yaml is there already, and +tuned=mine would take it in place of what this study finds" in ended.err
    assert "# Study: other" in file.read_text()


@pytest.mark.slow
def test_unlabelled_videos_need_the_elbo(tune: Callable[..., Ended]) -> None:
    ended = tune(SWEPT[0], "++data.labelled=false", "study.trials=1")
    assert ended.code == 1
    assert "write unsupervised=true" in ended.err


@pytest.mark.slow
def test_max_minutes_starts_no_further_trial(tune: Callable[..., Ended], the_study: Callable[[], optuna.Study]) -> None:
    ended = tune(SWEPT[0], "study.trials=50", "study.max_minutes=0.001")
    assert ended.code == 0
    assert "the same command resumes" in ended.out
    assert 1 <= len(the_study().get_trials()) < 50
    assert json.dumps(the_study().user_attrs["definition"])
