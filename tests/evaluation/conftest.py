from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from omegaconf import DictConfig, OmegaConf

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.files import write_json
from apex_lab.base.interrupts import Interrupted
from apex_lab.config.building import build_model
from apex_lab.config.command_line import CONFIG_ERROR, RUN_ERROR
from apex_lab.config.composition import plain
from apex_lab.evaluate import check_evaluation, evaluate
from apex_lab.runs import checkpoints
from tests.conftest import REPOSITORY, Ended, compose_job

Make = Callable[..., Path]
Ask = Callable[..., Ended]


@pytest.fixture
def make_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Make:
    """Makes what training leaves of a run of the tiny model with 5 test videos: make_run(seed=1) -> its folder."""
    monkeypatch.chdir(tmp_path)
    job = compose_job("data.test=5")

    def make(seed: int = 0, step: int = 6, name: str = "last", folder: str = "outputs/tiny_squares") -> Path:
        run = Path(folder) / f"seed_{seed}"
        (run / "checkpoints").mkdir(parents=True, exist_ok=True)
        config = job.config.model_copy(update={"seed": seed})
        inference = checkpoints.inference_part(config, build_model(config), step)
        made = {"step": step, "inference": inference, "training": None, "choices": job.choices}
        made["config"] = {**job.raw, "seed": seed}
        checkpoints.save(run / "checkpoints" / f"{name}.ckpt", made)
        write_json(run / "run.json", {"status": "finished", "seed": seed})
        return run

    return make


@pytest.fixture
def ask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Ask:
    """Runs an evaluation as the command line would, without Hydra: ask("checkpoint=...", "pictures=0") -> `Ended`."""
    monkeypatch.chdir(tmp_path)
    console.setup()
    usual = yaml.safe_load((REPOSITORY / "conf" / "evaluate.yaml").read_text())
    for key in ("defaults", "hydra"):
        del usual[key]
    usual["paths"] = {"outputs": "outputs", "data": "data"}
    usual["batch_size"] = 2

    def run(*words: str) -> Ended:
        # the models are those of tests/tiny.py
        trust = {} if any(word.startswith("predictions=") for word in words) else {"trust": True}
        asked = OmegaConf.merge(usual, trust, OmegaConf.from_dotlist(list(words)))
        assert isinstance(asked, DictConfig)
        capsys.readouterr()
        code = CONFIG_ERROR
        try:
            job = check_evaluation(plain(asked), {}, words)
            code = RUN_ERROR
            evaluate(job)
            code = 0
        except UserError as error:
            console.error(str(error))
        except Interrupted as stop:
            code = 128 + stop.signum
        said = capsys.readouterr()
        return Ended(code, said.out, said.err)

    return run
