"""Whatever is typed ends in work or in a sentence: words made of groups, keys and values that nobody would type."""

from __future__ import annotations

import importlib
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sims.errors import SimError
from tests.conftest import REPOSITORY, TINY, Ended

SECONDS = 20.0
"""Of processor time; a machine that does other things beside is not the command's fault."""

GROUPS = (
    "model",
    "data",
    "scale",
    "trainer",
    "logger",
    "callbacks",
    "paths",
    "+ablation",
    "+experiment",
    "+tuned",
    "+sweep",
)
WORDS = ("tiny", "apex", "op3", "squares", "smoke", "cpu", "no_entropy", "overfit", "auto", "csv", "default", "nix")
KEYS = (
    *("seed", "model", "optimizer", "lr_scale", "schedule", "loss", "data", "clips", "trainer", "logger", "callbacks"),
    *("evaluation", "paths", "model.components", "model.width", "model._target_", "optimizer.lr", "optimizer._target_"),
    *("schedule.noise", "schedule.noise.steps", "schedule.noise._target_", "loss.error", "loss.spread", "loss.x"),
    *("data.frames", "data.image_size", "data.train", "data.val", "data.test", "data.data_seed", "data._target_"),
    *("data.workers", "clips.batch_size", "clips.frames", "trainer.max_steps", "trainer.devices", "trainer.precision"),
    *("trainer.max_minutes", "trainer.gradient_clip_norm", "trainer.monitor", "trainer.log_interval", "callbacks.x"),
    *("trainer.validation_interval", "trainer.validation_videos", "trainer.checkpoint_interval", "logger.x", "x.y.z"),
    *("evaluation.split", "evaluation.videos", "evaluation.batch_size", "evaluation.chunk", "paths.outputs"),
    *("hydra.run.dir", "hydra.sweep.dir", "hydra.job.name", "hydra.sweeper.params", "hydra.launcher", "hydra", "sweep"),
)
VALUES = (
    *("", "null", "true", "0", "1", "-1", "2", "3.5", "1e308", "-1e308", "nan", "inf", str(10**30), str(2**63), "x"),
    *("[]", "{}", "[1,2]", "{a:1}", "[[[[]]]]", "'x'", "???", "${seed}", "${nope}", "${oc.env:HOME}", "${x", "'"),
    *(
        "1,2",
        "range(2)",
        "range(1000000000)",
        "~/a,~/b",
        "interval(0,1)",
        "choice(1,x)",
        "glob(*)",
        "glob(n*)",
        "../x",
        "/proc/x",
        "~/x",
        "a=b",
        "a b",
    ),
    *(
        "é",
        "\U0001f916",
        "\udcff",
        "y" * 5000,
        "{_target_: builtins.print}",
        "{_target_: os.getcwd}",
        "{_target_: nix}",
    ),
    *(
        "{_target_: nix}",
        "{_target_: torch.optim.SGD}",
        "{_target_: 3}",
        "tests.tiny.Layers",
        "torch.optim.LBFGS",
        "builtins.dict",
        ".",
    ),
)
OPTIONS = ("-m", "--cfg", "job", "--resolve", "--info", "--nix", "--package", "--help", "--config-dir", "--config-name")

word = st.one_of(
    st.builds(str.__add__, st.sampled_from(GROUPS).map("{}=".format), st.sampled_from((*WORDS, *VALUES))),
    st.builds(
        lambda sign, key, value: f"{sign}{key}={value}",
        st.sampled_from(("", "", "", "+", "++")),
        st.sampled_from(KEYS),
        st.sampled_from(VALUES),
    ),
    st.sampled_from((*KEYS, *GROUPS)).map(lambda key: f"~{key.lstrip('+')}"),
    st.sampled_from(OPTIONS),
    st.text(max_size=8),
)
lines = st.lists(word, min_size=1, max_size=3)


def cases(number: int) -> settings:
    """Settings of so many cases, the same ones at every start."""
    unfit = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
    return settings(max_examples=number, suppress_health_check=unfit, database=None, derandomize=True)


def ends_well(command: Callable[..., Ended], entry: str, words: list[str], folder: Path) -> None:
    os.chdir(folder)  # a command before may have been asked to go elsewhere
    began = time.process_time()
    ended = command(entry, *words)  # raises what the command lets through
    assert time.process_time() - began < SECONDS
    assert "Traceback" not in ended.out + ended.err, ascii(ended.err)
    assert ended.code in (0, 1, 2)
    assert ended.code == 0 or ended.err.strip()


@pytest.fixture(autouse=True)
def _home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))


@pytest.fixture
def no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """What passes all checks is work, which other tests do."""
    monkeypatch.setattr("apex_lab.train.train", lambda *_, **__: "finished")


@cases(40)
@given(words=lines)
def test_train(words: list[str], command: Callable[..., Ended], no_work: None, tmp_path: Path) -> None:
    ends_well(command, "train", [*TINY, *words], tmp_path)


@cases(10)
@given(words=st.lists(word, min_size=1, max_size=2))
def test_evaluate(words: list[str], command: Callable[..., Ended], tmp_path: Path) -> None:
    ends_well(command, "evaluate", words, tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@cases(250)
@given(words=lines)
def test_train_with_its_work(words: list[str], command: Callable[..., Ended], tmp_path: Path) -> None:
    ends_well(command, "train", [*TINY, *words], tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("model", ["apex", "gswm", "op3", "scalor", "slot_attention", "space", "oracle"])
@cases(20)
@given(words=lines)
def test_every_model(
    model: str, words: list[str], command: Callable[..., Ended], no_work: None, tmp_path: Path
) -> None:
    ends_well(command, "train", [f"model={model}", "data=sprites", "scale=smoke", *words], tmp_path)


def keys_of(file: Path) -> list[str]:
    """The keys that a command's own file sets, dotted."""

    def inside(content: dict[str, Any], prefix: str = "") -> list[str]:
        found = []
        for key, value in content.items():
            if prefix or key not in ("defaults", "hydra"):
                found += [f"{prefix}{key}", *(inside(value, f"{prefix}{key}.") if isinstance(value, dict) else [])]
        return found

    return inside(yaml.safe_load(file.read_text()))


@pytest.mark.slow
@pytest.mark.parametrize("entry", ["evaluate", "predict", "compare", "arrange", "tables.asked", "report.asked"])
@cases(30)
@given(data=st.data())
def test_keys_of_a_command_s_own(
    entry: str, data: st.DataObject, command: Callable[..., Ended], tmp_path: Path
) -> None:
    keys = keys_of(REPOSITORY / "conf" / f"{entry.partition('.')[0]}.yaml")
    values = (*VALUES, str(tmp_path), "/etc/passwd", "apex-p2d-cpu", "[x,y]", "*")
    own = st.builds(
        lambda sign, key, value: f"{sign}{key}={value}",
        st.sampled_from(("", "", "++")),
        st.sampled_from(keys),
        st.sampled_from(values),
    )
    ends_well(command, entry, data.draw(st.lists(st.one_of(own, own, own, word), min_size=1, max_size=4)), tmp_path)


PROGRAMS: dict[str, tuple[str, tuple[str, ...]]] = {
    "sims.p2d.__main__": (
        "generate",
        ("--out", "--set", "--workers", "--no-card", "verify", "card", "export", "--format", "--split", "--repair"),
    ),
    "sims.arrangement_clips.__main__": ("make", ("make", "verify", "--settings", "--workers", "--repair")),
    "sims.example_videos": ("write_videos", ("--out", "--videos", "--frames", "--size", "--seed")),
    "apex_lab.data.sketchy.command": (
        "prepare",
        ("--root", "--name", "--image-size", "--windows", "--workers", "--repair"),
    ),
    "apex_lab.data.own_videos.__main__": ("repair", ("verify", "--repair", "--path", "--workers")),
}
"""Command with options of its own -> what its work is called there, and its words."""


@pytest.mark.slow
@pytest.mark.parametrize("name", PROGRAMS)
@cases(30)
@given(data=st.data())
def test_programs_with_options(
    name: str,
    data: st.DataObject,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    work, own = PROGRAMS[name]
    values = (*VALUES, str(tmp_path), "/etc/passwd", "/etc", "x", "train=3", "frames=0", "coco", '{"seed": -1}', "full")
    words = data.draw(st.lists(st.one_of(st.sampled_from(own), st.sampled_from(values)), min_size=1, max_size=6))
    program = importlib.import_module(name)

    def done(*_: object, **__: object) -> None:
        raise SimError("work begins")

    monkeypatch.setattr(program, work, done)
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    began = time.process_time()
    try:
        code = program.main([word for word in words if "\0" not in word])
    except SystemExit as stop:
        code = stop.code
    except SimError:  # of a command that knows no simulator
        code = 1
    said = capsys.readouterr()
    assert time.process_time() - began < SECONDS
    assert "Traceback" not in said.out + said.err, ascii(said.err)
    assert code in (0, 1, 2, None)
    assert code in (0, None) or said.err.strip() or said.out.strip()


@pytest.mark.slow
@pytest.mark.parametrize("entry", ["status", "tables.asked", "report.asked", "bench", "tune"])
@cases(20)
@given(words=lines)
def test_other_commands(
    entry: str, words: list[str], command: Callable[..., Ended], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("apex_lab.bench.bench", lambda *_: None)
    monkeypatch.setattr("apex_lab.tune.tune", lambda *_: None)
    ends_well(command, entry, [*TINY, *words], tmp_path)
