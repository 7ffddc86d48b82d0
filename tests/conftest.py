"""What all tests share: one thread, a clean command line, and runs that end in a folder of the test's own."""

from __future__ import annotations

import importlib
import json
import logging
import os
import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import hypothesis
import pytest
import torch
from hydra import compose, initialize_config_dir
from jaxtyping import install_import_hook
from omegaconf import OmegaConf

import tests.typechecked
from tests.interrupts import hear_ctrl_c

# Shapes and types of every call are checked in all tests; so the hook comes before the first import of apex_lab.
install_import_hook("apex_lab", f"{tests.typechecked.__name__}.checked")

from apex_lab.config.composition import conf_dir, plain  # noqa: E402
from apex_lab.config.job import Job, check_job  # noqa: E402

hear_ctrl_c()

# A slow or busy machine is no flaw of what is tested.
hypothesis.settings.register_profile("no deadline", deadline=None)
hypothesis.settings.load_profile("no deadline")

REPOSITORY = Path(__file__).parent.parent
# The processes that tests start run this working tree too, wherever the installed package may lie.
os.environ["PYTHONPATH"] = os.pathsep.join(
    [str(REPOSITORY / "src"), str(REPOSITORY), *filter(None, [os.environ.get("PYTHONPATH")])]
)
TINY = (
    "--config-dir",
    str(REPOSITORY / "tests" / "conf"),
    "model=tiny",
    "data=squares",
    "scale=smoke",
    "evaluation.pictures=0",
)
"""Words that train the tiny model of tests/tiny.py, without pictures."""


@pytest.fixture(scope="session", autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@dataclass(frozen=True)
class Ended:
    """How a command ended: exit code and what it said."""

    code: int
    out: str
    err: str


@pytest.fixture
def command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., Ended]:
    """Runs an entry point in this process, in the test's folder: command("train", "seed=1") -> `Ended`."""
    monkeypatch.chdir(tmp_path)
    for name in [name for name in os.environ if name.startswith(("WANDB_", "APEX_LAB_", "TINY_"))]:
        monkeypatch.delenv(name)

    def run(entry: str, *words: str) -> Ended:
        module = importlib.import_module(f"apex_lab.{entry}")
        if entry == "evaluate" and not any(word.startswith(("trust=", "predictions=")) for word in words):
            words = (*words, "trust=true")  # most tests evaluate the models of tests/tiny.py
        monkeypatch.setattr(sys, "argv", [str(module.__file__), *words])
        capsys.readouterr()
        code, handlers, level = 0, logging.root.handlers[:], logging.root.level
        try:
            module.main()
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 1
        finally:
            # Hydra's --info sends all logging to the stream of this moment, and for good
            logging.root.handlers[:] = handlers
            logging.root.setLevel(level)
        said = capsys.readouterr()
        return Ended(code, said.out, said.err)

    return run


def compose_job(*words: str) -> Job:
    """The checked job of a command line of `train`, the tiny model by default."""
    defaults = ("model=tiny", "data=squares", "scale=smoke")
    chosen = [word.split("=")[0] for word in words]
    overrides = [*(word for word in defaults if word.split("=")[0] not in chosen), *words]
    with initialize_config_dir(version_base="1.3", config_dir=str(conf_dir())):
        search = f"hydra.searchpath=[file://{REPOSITORY / 'tests' / 'conf'}]"
        config = compose("train", overrides=[search, *overrides], return_hydra_config=True)
    choices = {name: word for name, word in config.hydra.runtime.choices.items() if word and "hydra/" not in name}
    return check_job(plain(OmegaConf.masked_copy(config, [key for key in config if key != "hydra"])), choices)


@pytest.fixture
def train(command: Callable[..., Ended]) -> Callable[..., Ended]:
    """Trains the tiny model: train("seed=1") -> `Ended`."""
    return lambda *words: command("train", *TINY, *words)


@pytest.fixture
def the_run(tmp_path: Path) -> Callable[..., Path]:
    """The only run folder (of a seed) that the test has made."""

    def find(seed: int = 0) -> Path:
        found = list((tmp_path / "outputs").glob(f"*/seed_{seed}"))
        assert len(found) == 1, found
        return found[0]

    return find


def train_in(folder: Path, *words: str) -> Path:
    """Trains in this process and a folder, for fixtures that several tests share; the folder of outputs."""
    with pytest.MonkeyPatch.context() as patched:
        patched.chdir(folder)
        patched.setattr(sys, "argv", ["train", *words])
        importlib.import_module("apex_lab.train").main()
    return folder / "outputs"


def wait_for_step(folder: Path, step: int) -> Path:
    """Waits until the run of seed 0 below a folder has stored a step; the run's folder."""
    for _ in range(6000):
        for file in folder.glob("outputs/*/seed_0/run.json"):
            if json.loads(file.read_text())["steps"] >= step:
                return file.parent
        time.sleep(0.01)
    raise AssertionError("the run did not get so far")


@pytest.fixture(scope="session")
def _outputs_of_one_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train_in(tmp_path_factory.mktemp("one_run"), *TINY)


@pytest.fixture
def trained(_outputs_of_one_run: Path, tmp_path: Path) -> Path:
    """Folder of a finished run of the tiny model, as `train()` leaves it; the test's own copy."""
    shutil.copytree(_outputs_of_one_run, tmp_path / "outputs")
    [run] = (tmp_path / "outputs").glob("*/seed_0")
    return run


@pytest.fixture(scope="session")
def p2d_smoke(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A word that lets tests of P2D at scale=smoke share its data, which the first of them makes."""
    return f"paths.data={tmp_path_factory.mktemp('data')}"
