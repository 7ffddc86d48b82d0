"""A checkpoint of a stranger builds nothing but components of the project."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from apex_lab.base.errors import UserError
from apex_lab.config import trust
from tests.conftest import REPOSITORY, Ended

SHIPPED = REPOSITORY / "sweeps" / "results" / "apex_p2d_cpu.ckpt"
OLD = REPOSITORY / "tests" / "pinned" / "format_1" / "apex_p2d_smoke_c2ea6a76" / "seed_0" / "checkpoints" / "last.ckpt"
HOSTILE = (
    "os.system",
    "subprocess.Popen",
    "builtins.exec",
    "builtins.eval",
    "importlib.import_module",
    "posix.system",
    "torch.load",
    "torch.hub.load",
    "torch.optim.Optimizer.step",
    "apex_lab.training.ranks.subprocess.Popen",
    "apex_lab.training.fit.L.Trainer",
    "apex_lab.data.video_set.np.load",
    "apex_lab.training.update.named_parameters",
    "apex_lab.data.p2d_source.generate",
    "apex_lab.data.P2DSource.prepare",
    "apex_lab.training.ranks.Path",
    "apex_lab.models.apex.model.torch.Tensor",
    "apex_lab.base.files.write_text",
    "apex_lab.data:P2DSource",
    "tests.tiny.Layers",
    "",
    7,
    ["os.system"],
)


@pytest.mark.parametrize("name", HOSTILE, ids=str)
def test_hostile_names_are_refused(name: Any) -> None:
    with pytest.raises(UserError, match="which is no component of apex_lab: write trust=true"):
        trust.check({"model": {"_target_": name}}, "x.ckpt")


@pytest.mark.parametrize(
    "name",
    [
        *("torch.optim.Adam", "torch.optim.RMSprop", "apex_lab.training.optimizers.Muon"),
        *("apex_lab.models.apex.Apex", "apex_lab.models.yardsticks.Oracle", "apex_lab.data.P2DSource"),
        *("apex_lab.training.schedules.Linear", "apex_lab.training.composite.Composite"),
    ],
)
def test_the_projects_own_components_are_allowed(name: str) -> None:
    config = {"a": [{"b": {"_target_": name}}]}
    trust.check(config, "x.ckpt")
    assert list(trust.targets(config)) == [("a[0].b._target_", name)]


def test_every_shipped_component_is_allowed() -> None:
    import yaml

    for path in (REPOSITORY / "conf").rglob("*.yaml"):
        trust.check(yaml.safe_load(path.read_text()), str(path))


@pytest.mark.parametrize(
    "place",
    [
        *("model", "data", "schedule.temperature", "loss.nll", "lr_scale", "optimizer"),
        *("model.encoder", "callbacks.x", "logger.x", "deep.list"),
    ],
)
@pytest.mark.parametrize("checkpoint", [SHIPPED, OLD], ids=["shipped", "format 1"])
def test_a_hostile_checkpoint_runs_nothing(
    place: str, checkpoint: Path, command: Callable[..., Ended], tmp_path: Path
) -> None:
    content = torch.load(checkpoint, weights_only=True)
    proof = tmp_path / "proof"
    node = {"_target_": "os.system", "command": f"touch {proof}"}
    config: Any = copy.deepcopy(content["config"])
    holder: Any = config
    words = place.split(".")
    for word in words[:-1]:
        holder = holder.setdefault(word, {}) if isinstance(holder.get(word), dict | None) else holder
    holder[words[-1]] = [node] if place == "deep.list" else node
    torch.save({**content, "config": config}, tmp_path / "hostile.ckpt")
    ended = command("evaluate", "checkpoint=hostile.ckpt", "trust=false")
    assert ended.code == 2
    assert "hostile.ckpt wants to build 'os.system'" in ended.err
    assert len(ended.err.splitlines()) == 1
    assert not proof.exists()


def test_a_class_of_the_users_own_needs_trust(
    train: Callable[..., Ended], command: Callable[..., Ended], the_run: Callable[..., Path]
) -> None:
    assert train().code == 0
    ended = command("evaluate", f"checkpoint={the_run()}", "trust=false")
    assert ended.code == 2
    assert "wants to build 'tests.tiny." in ended.err
    assert command("evaluate", f"checkpoint={the_run()}", "trust=true", "pictures=0").code == 0
