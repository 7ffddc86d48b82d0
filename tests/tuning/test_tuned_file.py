"""The file of a study's values, and the command that is printed for it: it trains with these values and no others."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path

import optuna
import pytest
import yaml
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf
from optuna.distributions import FloatDistribution
from optuna.trial import FrozenTrial, TrialState

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.config.composition import Composed, conf_dir, plain
from apex_lab.config.preflight import listed
from apex_lab.tuning import tuned_file
from apex_lab.tuning.study import Study, check_study
from apex_lab.tuning.tuned_file import refuse_taken, write_tuned
from tests.conftest import REPOSITORY, TINY, Ended

LR = "optimizer.lr=tag(log,interval(1e-3,1e-1))"
SIGMA = ("scale=smoke", "data=sprites", "+study=sigma")


@pytest.fixture
def check(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Study]:
    """check("optimizer.lr=...", "study.name=a", config_dir=...) -> checked study, as the entry point makes it."""
    monkeypatch.chdir(tmp_path)

    def make(*words: str, config_dir: str | None = None) -> Study:
        monkeypatch.setattr("sys.argv", ["tune", *(("--config-dir", config_dir) if config_dir else ())])
        own = [word for word in words if word.startswith(("study", "+study"))]
        GlobalHydra.instance().clear()
        with initialize_config_dir(version_base="1.3", config_dir=str(conf_dir())):
            config = compose("tune", overrides=own, return_hydra_config=True)
            raw = plain(OmegaConf.masked_copy(config, ["study", "paths"]))
            chosen = dict(word.lstrip("+").split("=") for word in own if word.startswith("+study="))
            study = check_study([word for word in words if word not in own], config_dir, raw, chosen)
        return study

    return make


def found(study: Study, value: float) -> FrozenTrial:
    """A trial that is complete, with one value for all keys."""
    keys = [parameter.key for parameter in study.parameters]
    return optuna.create_trial(
        state=TrialState.COMPLETE,
        values=[0.5],
        params=dict.fromkeys(keys, value),
        distributions=dict.fromkeys(keys, FloatDistribution(0, 1)),
    )


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Lines that were printed."""
    lines: list[str] = []
    monkeypatch.setattr(console, "say", lines.append)
    return lines


def printed(study: Study, value: float, said: list[str]) -> Composed:
    """What the printed command composes."""
    said.clear()
    write_tuned(study, found(study, value))
    (line,) = [line for line in said if line.startswith("use them: ")]
    words = shlex.split(line.removeprefix("use them: "))
    assert words[:3] == ["python", "-m", "apex_lab.train"]
    folder = words[words.index("--config-dir") + 1] if "--config-dir" in words else None
    (made,) = listed([word for word in words[3:] if word not in ("--config-dir", folder)], folder)
    return made


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A conf/ with the shipped files, in which a study with a name may write."""
    folder = tmp_path / "conf"
    (folder / "tuned").mkdir(parents=True)
    for path in conf_dir().iterdir():
        if path.name != "tuned":
            (folder / path.name).symlink_to(path)
    for path in (conf_dir() / "tuned").iterdir():
        (folder / "tuned" / path.name).write_bytes(path.read_bytes())
    for module in ("composition", "preflight"):
        monkeypatch.setattr(f"apex_lab.config.{module}.conf_dir", lambda: folder, raising=False)
    monkeypatch.setattr(tuned_file, "conf_dir", lambda: folder)
    return folder


@pytest.mark.parametrize("where", ["own folder", "study.conf", "repository"])
def test_the_printed_command_trains_the_values_of_a_study_whose_name_a_shipped_file_has(
    where: str,
    check: Callable[..., Study],
    said: list[str],
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ready studies: conf/tuned/sigma.yaml is there already."""
    if where == "repository":
        request.getfixturevalue("repository")
    study = check(*SIGMA, *(("study.conf=mine",) if where == "study.conf" else ()))
    if where == "own folder":  # as from an installed package
        monkeypatch.setattr(tuned_file, "_searched", lambda study: study.folder / "conf")
    refuse_taken(study)
    made = printed(study, 0.123, said)
    assert made.choices["tuned"] == study.tuned != "sigma"
    assert {made.raw["model"]["likelihood"][key] for key in ("sigma_fg", "sigma_bg")} == {0.123}
    assert made.raw["schedule"]["sigma_fg_scale"]["start"] == 1.0
    shipped = yaml.safe_load((conf_dir() / "tuned" / "sigma.yaml").read_text())
    assert shipped["model"]["likelihood"]["sigma_fg"] != 0.123  # it stays


def test_the_printed_command_has_the_folder_and_the_parts_of_the_trials(
    check: Callable[..., Study], tmp_path: Path, said: list[str]
) -> None:
    folder = tmp_path / "my files"
    folder.mkdir()
    for name in ("model", "data", "recipe"):
        (folder / name).symlink_to(Path(TINY[1]) / name)
    study = check(*TINY[2:], LR, "study.name=a.b", config_dir=str(folder))
    made = printed(study, 0.02, said)
    assert (made.choices["model"], made.choices["tuned"], made.raw["optimizer"]["lr"]) == ("tiny", "a_b", 0.02)
    words = (
        "scale=smoke",
        "data=sprites",
        "model/apex/likelihood=gaussian",
        "model.likelihood.sigma=interval(0.1,0.3)",
    )
    study = check(*words, "study.conf=mine", "study.name=g")
    assert printed(study, 0.2, said).raw["model"]["likelihood"]["sigma"] == 0.2
    study = check(*TINY[2:], LR, "study.conf=mine", config_dir=TINY[1])
    write_tuned(study, found(study, 0.02))
    assert f"put the files of {TINY[1]} there too" in said[-1]


def test_a_name_that_would_take_another_file_is_refused(
    check: Callable[..., Study], command: Callable[..., Ended], tmp_path: Path
) -> None:
    words = ("scale=smoke", "data=sprites", LR)
    ended = command("tune", *words, "study.name=sigma")  # the repository's, of another study
    assert ended.code == 2
    assert ended.err.count("\n") == 1
    assert "tuned/sigma.yaml is there already, and +tuned=sigma would take it in place of what" in ended.err
    assert not (tmp_path / "outputs").exists()
    with pytest.raises(UserError, match=r"tuned/op3\.yaml is there already"):  # of this name, but found first
        refuse_taken(check(*words, "study.conf=mine", "study.name=op3"))
    study = check(*words, "study.conf=mine", "study.name=m")
    refuse_taken(study)
    write_tuned(study, found(study, 0.02))
    refuse_taken(study)  # its own
    file = tmp_path / "mine" / "tuned" / "m.yaml"
    file.write_text(file.read_text().replace("# Study: m", "# Study: other"))
    with pytest.raises(UserError, match=r"choose another study\.name"):
        write_tuned(study, found(study, 0.03))
    assert "# Study: other" in file.read_text()


def test_of_two_tuned_files_of_one_name_none_is_taken(tmp_path: Path) -> None:
    file = tmp_path / "tuned" / "sigma.yaml"
    file.parent.mkdir()
    shipped = (REPOSITORY / "conf" / "tuned" / "sigma.yaml").read_text()
    file.write_text(shipped)
    assert listed(["scale=smoke", "+tuned=sigma"], str(tmp_path))
    file.write_text(shipped + "seed: 3\n")
    with pytest.raises(UserError) as refused:
        listed(["scale=smoke", "+tuned=sigma"], str(tmp_path))
    assert str(refused.value) == f"+tuned=sigma takes another file than {file}, which has its name: rename that one."


@pytest.mark.parametrize(
    ("name", "of", "model"),
    [("gswm", "gswm", "op3"), ("sigma", "apex", "space"), ("op3", "op3", "apex"), ("slot_attention",) * 2 + ("op3",)],
)
def test_the_values_of_another_model_are_refused(name: str, of: str, model: str) -> None:
    with pytest.raises(UserError) as refused:
        listed(["scale=smoke", f"model={model}", f"+tuned={name}"])
    assert str(refused.value) == (
        f"+tuned={name} has values for model={of} ({REPOSITORY / 'conf' / 'tuned' / name}.yaml), and this run has "
        f"model={model}: leave out +tuned={name}, or choose model={of}."
    )


def test_a_model_without_training_has_nothing_to_tune(check: Callable[..., Study]) -> None:
    for word in ("optimizer.lr=interval(1e-4,1e-2)", "model.components=choice(2,3)"):
        with pytest.raises(UserError, match=r"^model=oracle is not trained, so nothing can be pruned or tuned\.$"):
            check("scale=smoke", "model=oracle", word)
