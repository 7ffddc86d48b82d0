"""A checkpoint of a stranger builds nothing but components of the project."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from apex_lab.base.errors import UserError
from apex_lab.base.files import write_json
from apex_lab.config import trust
from apex_lab.runs import progress
from apex_lab.runs.folder import group_name, run_folder
from apex_lab.tables.found import read_run
from apex_lab.training.ranks import Ranks
from apex_lab.training.worker import train_along
from tests.conftest import REPOSITORY, Ended, compose_job

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
    for path in (REPOSITORY / "conf").rglob("*.yaml"):
        content = yaml.safe_load(path.read_text())
        if path.parent.parent.name == "study":  # samplers and pruners are a study's; no checkpoint holds them
            assert content["_target_"].startswith(f"optuna.{path.parent.name}s.")
        elif path.parent.name == "perception":  # of apex_lab.arrange; no checkpoint holds one
            assert content.pop("_target_").startswith("apex_lab.arrangement.perception.")
            trust.check(content, str(path))
        else:
            trust.check(content, str(path))


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


def test_a_class_of_the_users_own_needs_trust(trained: Path, command: Callable[..., Ended]) -> None:
    ended = command("evaluate", f"checkpoint={trained}", "trust=false")
    assert ended.code == 2
    assert "wants to build 'tests.tiny." in ended.err
    assert command("evaluate", f"checkpoint={trained}", "trust=true", "pictures=0").code == 0


ENV = "${oc.env:HOME}"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("model: {_target_: os.system, command: x}", "x.yaml wants to build 'os.system' (model._target_)"),
        ("model: {encoder: [{_target_: builtins.exec}]}", "wants to build 'builtins.exec' (model.encoder[0]._target_)"),
        ("optimizer._target_: os.system", "wants to build 'os.system' (optimizer._target_)"),
        ("hydra: {callbacks: {a: {_target_: os.system}}}", "wants to build 'os.system' (hydra.callbacks.a._target_)"),
        (
            "hydra: {run: {dir: /}}",
            "x.yaml may not set hydra.run.dir, which is Hydra's own: give it on the command line.",
        ),
        ("hydra.job.chdir: true", "x.yaml may not set hydra.job.chdir, which is Hydra's own"),
        ("hydra: {}", "x.yaml may not set hydra, which is Hydra's own"),
        (f"model: {{name: '{ENV}'}}", f"x.yaml may not hold '{ENV}': write the value itself."),
        ("model: {grid: ['a${data.frames}']}", "x.yaml may not hold 'a${data.frames}': write the value itself."),
        ("defaults: [/model: '${oc.env:X}']", "may not have {'/model': '${oc.env:X}'} among its defaults"),
        ("defaults: [/hydra/launcher: joblib]", "may not have {'/hydra/launcher': 'joblib'} among its defaults"),
        ("defaults: [override /hydra/job_logging: x]", "may not have {'override /hydra/job_logging': 'x'} among"),
        ("defaults: [/model: ../../mine]", "may not have {'/model': '../../mine'} among its defaults"),
        ("defaults: [/recipe/apex/paper]", "may not have '/recipe/apex/paper' among its defaults"),
        ("defaults: /model", "may not have '/model' among its defaults"),
        ("[1, 2]", "x.yaml must set values of keys, and holds [1, 2]."),
    ],
)
def test_a_file_of_values_does_nothing_else(text: str, told: str) -> None:
    with pytest.raises(UserError) as refused:
        trust.only_values(yaml.safe_load(text), "x.yaml")
    assert told in str(refused.value)


def test_files_of_values_are_taken() -> None:
    text = """
    defaults: [override /model/apex/likelihood: gaussian, optional /scale: cpu, _self_]
    model: {grid: 4, widths: [1, 2], likelihood: {sigma: 0.1}, nothing: {}}
    optimizer: {_target_: torch.optim.Adam, lr: 1.0e-3}
    loss.mask_entropy: 0.0
    """
    trust.only_values(yaml.safe_load(text), "x.yaml")
    trust.only_values({"a": {"_target_": "mine.Own"}}, "x.yaml", known=["mine.Own"])


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("model._target_=os.system", "wants to build 'os.system' (model._target_)"),
        ("+callbacks.x={_target_:os.system,command:x}", "wants to build 'os.system' (callbacks.x._target_)"),
        ("++model.a=[{_target_:builtins.exec}]", "wants to build 'builtins.exec' (model.a[0]._target_)"),
        ("model._target_=os.system,os.popen", "write the values as a list"),
        ("model._target_=choice(os.system)", "write the values as a list"),
        ("hydra.run.dir=/", "may not set hydra.run.dir"),
        ("hydra/launcher=joblib", "may not set hydra"),
        ("+hydra.searchpath=[pkg://x]", "may not set hydra.searchpath"),
        ("model.name=${oc.env:HOME}", "may not hold 'model.name=${oc.env:HOME}'"),
        ("model.name='${oc.env:HOME}'", "may not hold"),
        ("model.grid=1,${oc.env:HOME}", "may not hold"),
        ("+tuned@_global_=evil", "a choice has its own place"),
        ("model@x=apex", "a choice has its own place"),
    ],
)
def test_words_of_a_file_do_nothing_but_set_values(word: str, told: str) -> None:
    with pytest.raises(UserError) as refused:
        trust.only_words(["seed=0", word], "x.yaml")
    assert told in str(refused.value)


def test_words_that_set_values_are_taken() -> None:
    words = ["model=apex", "+ablation=no_entropy", "seed=0,1", "model.grid=range(2,5)", "~callbacks.progress"]
    trust.only_words([*words, "optimizer._target_=torch.optim.Adam", "a={b:[1]}", "x=null", "y=''"], "x.yaml")


@pytest.mark.parametrize("group", ["tuned", "sweep"])
def test_hostile_files_of_the_command_line_run_nothing(
    group: str, command: Callable[..., Ended], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    proof = tmp_path / "proof"
    folder = tmp_path / "conf" / group
    folder.mkdir(parents=True)
    node = f"{{_target_: os.system, command: 'touch {proof}'}}"
    monkeypatch.setenv("SECRET", "3")
    texts = {
        "tuned": [
            f"callbacks: {{x: {node}}}",
            "model: {grid: '${oc.decode:${oc.env:SECRET}}'}",
            "hydra: {job: {chdir: true}}",
        ],
        "sweep": [
            f"jobs: [{{+callbacks.x: '{{_target_: os.system, command: touch {proof}}}'}}]",
            "jobs: [{model.grid: '${oc.decode:${oc.env:SECRET}}'}]",
            "jobs: [{hydra.job.chdir: true}]",
        ],
    }
    for text in texts[group]:
        head = "# @package _global_\n" if group == "tuned" else ""
        (folder / "x.yaml").write_text(head + text)
        words = ("--config-dir", str(tmp_path / "conf"), "scale=smoke", f"+{group}=x")
        ended = command("train", *words, *(["-m"] if group == "sweep" else []))
        assert ended.code == 2, text
        assert "x.yaml wants to build 'os.system'" in ended.err or "x.yaml may not" in ended.err, ended.err
        assert len(ended.err.splitlines()) == 1
        assert not proof.exists()
        assert not (tmp_path / "outputs").exists()


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("+tuned@_global_=nested", "a choice of tuned has its own place: leave out @_global_."),
        ("+ablation@_global_=gaussian", "a choice of ablation has its own place: leave out @_global_."),
        ("+tuned=headed", "headed.yaml may not be put at hydra.run: write # @package _global_"),
        ("+tuned=chooses", "chooses.yaml may only choose files of apex_lab, and model/mine.yaml lies elsewhere."),
    ],
)
def test_choices_go_where_they_are_looked_at(
    word: str, told: str, command: Callable[..., Ended], tmp_path: Path
) -> None:
    for name, text in {
        "tuned/nested": "# @package _global_\ncallbacks: {x: {_target_: os.system, command: 'true'}}",
        "tuned/headed": "# @package hydra.run\ndir: elsewhere",
        "tuned/chooses": "# @package _global_\ndefaults: [{override /model: mine}]",
        "model/mine": "_target_: os.system\ncommand: 'true'",
    }.items():
        file = tmp_path / "conf" / f"{name}.yaml"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    ended = command("train", "--config-dir", str(tmp_path / "conf"), "scale=smoke", word)
    assert ended.code == 2
    assert told in ended.err
    assert not (tmp_path / "elsewhere").exists()


def test_the_config_yaml_of_a_run_folder_is_compared_and_never_built(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    job = compose_job()
    proof = tmp_path / "proof"
    planted = Path("outputs") / f"{group_name(job).rpartition('_')[0]}_00000000" / "seed_0"
    planted.mkdir(parents=True)
    words = {"model": "tiny", "data": "squares", "scale": "smoke"}
    write_json(planted / "run.json", {"format": 1, "status": "finished", "seed": 0, **words})
    hostile = {**job.raw, "model": {"_target_": "os.system", "command": f"touch {proof}"}}
    for text in (yaml.safe_dump(hostile), f"model: !!python/object/apply:os.system ['touch {proof}']", "seed: 0"):
        (planted / "config.yaml").write_text(text)
        assert run_folder(job).parent.name == group_name(job)
        assert [seen.state.folder for seen in progress.found(Path("outputs")).jobs] == [planted]
        assert read_run(planted, 0) is not None
        assert not proof.exists()


def test_a_job_file_in_a_run_folder_builds_what_the_own_command_names_alone(tmp_path: Path) -> None:
    job = compose_job()
    config = {**job.config.model_dump(), "model": {"_target_": "os.system", "command": "true"}}
    torch.save({"config": config, "weights": {}, "device": "cpu", "step": 0, "training": None}, tmp_path / "job.pt")
    with pytest.raises(UserError, match=r"job\.pt wants to build 'os\.system' \(model\._target_\)"):
        train_along(tmp_path / "job.pt", Ranks(1, 2), [str(name) for _, name in trust.targets(job.raw)])


@pytest.mark.parametrize(
    ("call", "wanted"),
    [("np.load(", "allow_pickle=False"), ("torch.load(", "weights_only=True"), ("read_array(", "allow_pickle=False")],
)
def test_every_reader_is_told_to_run_no_code(call: str, wanted: str) -> None:
    """ruff's rules S301, S302, S307 and S506 look after pickle, eval and yaml.load."""
    found = 0
    for path in (*(REPOSITORY / "src").rglob("*.py"), *(REPOSITORY / "sims").rglob("*.py")):
        for line in path.read_text().splitlines():
            if call in line and "`" not in line and path.name != "readme.py":
                found += 1
                assert wanted in line, (path, line)
    assert found
