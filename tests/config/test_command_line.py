"""What the command line refuses, in which words, and that nothing has been started then."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from apex_lab.config.options import arrange, at_home
from tests.conftest import REPOSITORY, TINY, Ended

REFUSED = {
    "trainer.max_step=3": r"Unknown key trainer.max_step = 3; did you mean 'trainer.max_steps'?",
    "++trainer.max_step=3": r"Unknown key trainer.max_step = 3; did you mean 'trainer.max_steps'?",
    "++typo=1": "Unknown key typo = 1.",
    "+ablaton=no_entropy": "Unknown key ablaton = 'no_entropy'; did you mean 'ablation'?",
    "modle=tiny": "Unknown key modle = 'tiny'; did you mean 'model'?",
    "ablation=no_entropy": "ablation=no_entropy has no default to replace: write +ablation=no_entropy.",
    "seed=0,1": "seed=0,1 holds several values: add -m to run them all, or write seed=[0,1] for a list.",
    "++hydra.job.nme=x": "Unknown key hydra.job.nme=x; did you mean 'name'?",
    "+seed=3": "seed is there already: write seed=3 without the +.",
    "trainer.max_steps=abc": "trainer.max_steps = 'abc' is wrong: input should be a valid integer.",
    "++trainer.max_steps=abc": "trainer.max_steps = 'abc' is wrong: input should be a valid integer.",
    "trainer.max_steps=0": "trainer.max_steps = 0 is wrong: input should be greater than or equal to 1.",
    "trainer.max_steps=2.5": "trainer.max_steps = 2.5 is wrong",
    "trainer.compile=1": "trainer.compile = 1 is wrong: input should be a valid boolean.",
    "trainer.precision=16": "trainer.precision = 16 is wrong: input should be 32 or 'bf16-mixed'.",
    "trainer.monitor=ari": "trainer.monitor = 'ari' is wrong",
    "trainer.monitor=val/arifg": "trainer.monitor = 'val/arifg' is none of val/ari_fg,",
    "data.test=0": "data.test = 0",
    "seed=-1": "seed = -1 is wrong: input should be greater than or equal to 0.",
    "seed=": "seed = '' is wrong: input should be a valid integer.",
    "seed=null": "seed = null is wrong: input should be a valid integer.",
    "paths.outputs=null": "paths.outputs = null is wrong: input should be a valid string.",
    "optimizer.lr=abc": "optimizer.lr = 'abc' is wrong: input should be a valid number.",
    "optimizer.lr=0": "optimizer.lr = 0 is wrong: a learning rate is above 0.",
    "optimizer.lr=nan": "optimizer.lr = NaN is wrong: input should be a finite number.",
    "++optimizer.lrr=3": "Unknown key optimizer.lrr = 3; did you mean 'lr'?",
    "optimizer.weight_decay=0.1": "is set by no file that was chosen: write ++optimizer.weight_decay=0.1 to add it.",
    "++optimizer.betas=[0.9,1.5]": "optimizer (torch.optim.Adam): Invalid beta parameter at index 1: 1.5.",
    "optimizer=null": "optimizer = null, but the model has weights to train: choose one, such as torch.optim.Adam.",
    "+model.component=3": "Unknown key model.component = 3; did you mean 'components'?",
    "model.components=2.5": "model.components = 2.5 is wrong: input should be a valid integer.",
    "model.components=1": "model (tests.tiny.Layers): components = 1 leaves no room for an object: give at least 2.",
    "model._target_=tests.tiny.Layer": "model._target_ = 'tests.tiny.Layer' cannot be imported",
    "model._target_=tests.tiny.SquaresSource": "model.components is set by the files that were chosen, and tests.tiny.",
    "loss.spred=1": "Unknown key loss.spred: the model has error, spread; did you mean 'spread'?",
    "~loss.spread": "loss.spread is missing: the model needs error, spread.",
    "loss.error=x": "loss.error = 'x' is wrong",
    "loss.error={a:1}": "loss.error = {'a': 1} is wrong: give a number or a schedule with a _target_.",
    "~schedule.noise": "schedule.noise is missing: the model needs noise.",
    "schedule.noise=2": "schedule.noise = 2 is wrong: a schedule has keys: set those, or give another one with a",
    "schedule.noise.steps=-1": "schedule.noise.steps = -1 is wrong: input should be greater than or equal to 0.",
    "data.frames=0": "data.frames = 0 is wrong: input should be greater than or equal to 1.",
    "data.frames=???": "data.frames is missing: write data.frames=...",
    "data.frames=${nope}": "Interpolation key 'nope' not found.",
    "evaluation.split=tst": "evaluation.split = 'tst' is wrong: input should be 'train', 'val' or 'test'.",
    "callbacks.progress.seconds=0": "callbacks.progress.seconds = 0 is wrong: input should be greater than 0.",
    "logger=wand": "logger=wand: there is no such choice in csv, tensorboard, wandb; did you mean 'wandb'?",
    "scale=cpuu": "did you mean 'cpu'?",
    "+ablation=no_entropi": "did you mean 'no_entropy'?",
    "+ablation=[no_entropy,gaussian]": "puts several into one run: write +ablation=no_entropy,gaussian -m to run each.",
    "+ablation=no_entropy,gaussian": "ablation=no_entropy,gaussian holds several values: add -m to run them all.",
    "+ablation=gaussian": "ablation=gaussian swaps APEX's likelihood, and no APEX is chosen here: add model=apex.",
    "clips.batch_size=0": "clips.batch_size = 0 is wrong: input should be greater than or equal to 1.",
    "clips.frames=0": "clips.frames is 0 at step 0: a clip has at least one frame.",
    "clips.frames=4": "clips.frames is 4 at step 0, but videos have data.frames = 3 frames.",
    "clips.frames={a:1}": "clips.frames = {'a': 1} is wrong: give a number or a schedule with a _target_.",
    "trainer.devices=3": "clips.batch_size = 2 is the global batch, which 3 processes (trainer.devices x trainer.num_n",
    "scale=cpu": "model=tiny has no recipe conf/recipe/tiny/cpu.yaml",
    "data.batch_size=4": "Unknown key data.batch_size = 4",
    "loss.error=-1": "loss.error is -1 at step 0: it must be at least 0.",
    "model=null": "model=null names no choice of model: write one of apex, background_subtraction,",
    "+ablation=3": "+ablation=3 names no choice of ablation: write one of gaussian,",
    "trainer=[]": "trainer",
    "~model": "~model leaves no model, and every run has one: choose it by model=...",
    "model=tiny.yaml": "model=tiny.yaml is no name of a choice: write model=tiny.",
    "model=../model/tiny": "model=../model/tiny is no name of a choice: write model=tiny.",
    "model.width=10000000000": "model (tests.tiny.Layers) asks for 1,080.0 GB at once, and",
    "data.frames=1000000000000": "clips.batch_size = 2, data.frames = 1000000000000, data.image_size = 32: a batch of",
    "trainer.max_steps=1000000000000000000000000000000": "trainer.max_steps = a whole number of 100 bits is wrong",
    "+callbacks.x={_target_: builtins.print}": "callbacks.x._target_ = 'builtins.print' is no Callback of Lightning",
    "+logger.x={_target_: tests.tiny.Layers}": "logger.x._target_ = 'tests.tiny.Layers' is no Logger of Lightning",
    "loss.error={_target_: os.getcwd}": "loss.error is not a schedule: choose one of apex_lab.training.schedules.",
    "loss.error=1e308": "loss.error = 1e+308 is wrong: no number in single precision is above 3.40282e+38 in size.",
    "lr_scale=1e38": "lr_scale is 1e+38 at step 0: it must be between 0 and 1e+09.",
    "lr_scale=-1e308": "lr_scale = -1e+308 is wrong: no number in single precision is above 3.40282e+38 in size.",
    "optimizer.lr=1e38": "optimizer: a learning rate of 1e+38 is wrong: it is at most 1e+09.",
    "recipe=null": "recipe=null names no choice of recipe: write one of apex/cpu,",
    "schedule.noise._target_=os.getcwd": "is set by the files that were chosen, and os.getcwd does not take it: to",
    "optimizer={_target_: torch.optim.SparseAdam}": "cannot update this model's weights: RuntimeError: Sparse",
    "optimizer={_target_: torch.optim.SGD, eps: 1}": "Unknown key optimizer.eps = 1",
    "paths.outputs=": "paths.outputs = '' is wrong: it is empty, as an unset variable is: give a path.",
    f"paths.outputs=/{'x' * 5000}": "paths.outputs = '/xxx",
    "hydra.searchpath=[file:///nowhere]": "hydra.searchpath: /nowhere is not available: give folders that are there.",
    "--resolve": "--resolve goes with --cfg alone: write --cfg job --resolve.",
    "--package=x": "--package goes with --cfg alone",
    "--experimental-rerun=x": "--experimental-rerun is not read here: the command of a run, typed again, resumes it.",
    "--cfg=nix": "Argument --cfg/-c: invalid choice: 'nix'",
    "--nix": "Unrecognized arguments: --nix.",
    "hydra.run.dir=/proc/x": "hydra.run.dir or hydra.sweep.dir: /proc/x cannot be written (No such file or directory)",
    "hydra.output_subdir=/proc/x": "hydra.run.dir or hydra.sweep.dir: /proc/x cannot be written",
    "words": "'words' cannot be read as key=value",
    "x=[1": "'x=[1' cannot be read as key=value",
}


def refused(ended: Ended, told: str, folder: Path) -> None:
    assert ended.code == 2
    assert told in ended.err
    assert len(ended.err.splitlines()) == 1
    assert ended.out == ""
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("word", REFUSED)
def test_refuses_before_anything_starts(word: str, train: Callable[..., Ended], tmp_path: Path) -> None:
    refused(train(word), REFUSED[word], tmp_path)


def test_every_job_of_a_sweep_is_checked_before_the_first_starts(train: Callable[..., Ended], tmp_path: Path) -> None:
    refused(train("seed=0,1,-2,3", "-m"), "seed = -2 is wrong", tmp_path)
    refused(train("model.components=2,3,1", "seed=range(2)", "-m"), "components = 1 leaves no room", tmp_path)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            "hydra.launcher._target_=nix",
            "hydra.launcher._target_=nix is no launcher of Hydra: choose one by hydra/launcher=...",
        ),
        ("hydra.sweep.dir=/proc/x", "hydra.run.dir or hydra.sweep.dir: /proc/x cannot be written (No such file"),
        ("hydra.sweeper.max_batch_size=0", "Unknown key hydra.sweeper.max_batch_size=0."),
        (
            "hydra.sweeper.slots=0",
            "hydra.sweeper.slots=0: give the number of jobs that a machine does at once, or null.",
        ),
        ("hydra/launcher=jobli", "hydra/launcher=jobli: there is no such choice in basic"),
        ("hydra.sweeper.slot=2", "Unknown key hydra.sweeper.slot=2; did you mean 'slots'?"),
        ("+hydra.launcher.tasks_per_node=2", "Unknown key hydra.launcher.tasks_per_node=2."),
    ],
)
def test_launchers_that_cannot_be(words: str, told: str, train: Callable[..., Ended], tmp_path: Path) -> None:
    refused(train("seed=0,1", words, "-m"), told, tmp_path)


def test_choices_that_a_pattern_names(train: Callable[..., Ended], tmp_path: Path) -> None:
    refused(train("+ablation=glob(no_*)", "seed=x", "-m"), "seed = 'x' is wrong", tmp_path)
    refused(train("+ablation=glob(x*)", "-m"), "+ablation=glob(x*) fits no choice of ablation.", tmp_path)
    refused(train("model=glob(tin*)", "seed=x", "-m"), "seed = 'x' is wrong", tmp_path)  # in the folder of --config-dir


def test_data_that_a_recipe_has_no_settings_for(command: Callable[..., Ended], tmp_path: Path) -> None:
    told = "recipe/gswm/cpu_for has no file for data=video: take another data set's, such as recipe/gswm/cpu_for=p2d,"
    refused(command("train", "model=gswm", "data=video", "data.path=.", "scale=cpu"), told, tmp_path)


def test_shell_completion_of_one_shell(command: Callable[..., Ended], tmp_path: Path) -> None:
    for words in ((), ("x",), ("install=nix",), ("install=bash", "seed=1")):
        refused(command("train", "--shell-completion", *words), "goes with one word alone: install=bash,", tmp_path)


def test_lists_without_end(train: Callable[..., Ended], tmp_path: Path) -> None:
    refused(train("seed=range(1000000000)", "-m"), "seed=range(1000000000) holds more than 100,000 values", tmp_path)
    words = ("seed=range(10000)", "trainer.max_steps=range(1,100)", "-m")
    refused(train(*words), "These words make 990,000 jobs, and one command runs 100,000 at most", tmp_path)
    refused(train("+sweep=glob(*)", "-m"), "+sweep=glob(*) is a pattern, which fits files of a group alone", tmp_path)
    refused(
        train("+sweep=../sweep/paper", "-m"),
        "sweep=../sweep/paper is no name of a choice: write sweep",
        tmp_path,
    )


def test_a_key_that_only_swept_models_have(command: Callable[..., Ended], tmp_path: Path) -> None:
    words = ("model=background_subtraction,color_clusters", "model.min_area=0.004", "data=sprites", "scale=smoke")
    ended = command("train", *words, "evaluation.pictures=0", "-m")
    assert ended.code == 0, ended.err
    assert len(list(tmp_path.glob("outputs/*/seed_0/metrics.json"))) == 2


def test_a_sweep_in_an_experiment_is_checked_first(command: Callable[..., Ended], tmp_path: Path) -> None:
    folder = tmp_path.parent / f"{tmp_path.name}_conf"
    for file in (REPOSITORY / "tests" / "conf").rglob("*.yaml"):
        place = folder / file.relative_to(REPOSITORY / "tests" / "conf")
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(file.read_bytes())
    (folder / "experiment").mkdir()
    text = "# @package _global_\nhydra:\n  mode: MULTIRUN\n  sweeper:\n    params:\n      seed: 0,x\n"
    (folder / "experiment" / "swept.yaml").write_text(text)
    words = ("--config-dir", str(folder), *TINY[2:], "+experiment=swept")
    for further in ((), ("-m",)):
        refused(command("train", *words, *further), "seed = 'x' is wrong", tmp_path)


def test_home_folders_are_written_out(
    train: Callable[..., Ended], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "my home"))
    for word in ("paths.outputs=~/runs", "paths.outputs='~/runs'", 'paths.outputs="~/runs"'):
        ended = train(word, "--cfg", "job", "--package", "paths")
        assert f"outputs: {tmp_path / 'my home'}/runs" in " ".join(ended.out.split()), ended.err


def test_home_folders_of_commands_that_read_runs(
    command: Callable[..., Ended], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    ended = command("status", "--once", "paths.outputs=~/runs")
    assert (ended.code, ended.out) == (0, "There are no runs.\n")
    assert f"The folder {tmp_path}/runs (paths.outputs) does not exist." in " ".join(ended.err.split())
    (tmp_path / "runs").touch()
    ended = command("status", "--once", "paths.outputs=~/runs")
    assert f"paths.outputs = {tmp_path}/runs cannot be read (Not a directory)" in ended.err


@pytest.mark.parametrize(
    ("word", "wanted"),
    [
        ("a=[~/r,~/s]", "a=[/home/me/r,/home/me/s]"),
        ("""a=["~/r", '~/s t']""", """a=["/home/me/r", '/home/me/s t']"""),
        ("a=~/r,~/s t", 'a=/home/me/r,"/home/me/s t"'),
        ("video='~/a,b.mp4'", "video='/home/me/a,b.mp4'"),
        *((word, word) for word in ("a=~no_such_user/x", "~a", "~a=3", "a=b~/c", 'a="x,~/y"', "a=", "a=[]", "~")),
    ],
)
def test_where_a_home_folder_is_meant(word: str, wanted: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/me")
    assert at_home(word) == wanted


def test_what_is_merged_is_told(train: Callable[..., Ended], tmp_path: Path) -> None:
    told = "optimizer={...} is merged into what the files set there, optimizer."
    refused(train("++optimizer.muon_lr=0.1", "optimizer={_target_: torch.optim.SGD}"), told, tmp_path)


def test_an_ablation_of_another_model_is_named(command: Callable[..., Ended], tmp_path: Path) -> None:
    told = "+ablation=no_entropy sets loss.mask_entropy, which model=oracle does not have: leave out the ablation"
    refused(command("train", "model=oracle", "data=sprites", "scale=smoke", "+ablation=no_entropy"), told, tmp_path)


@pytest.mark.parametrize(
    "name", ["odd/${oc.env:HOME}.mp4", "a${b", "$${x}", "\\${a}", "a\\\\b ${x}, c", "it's ${x}'", "${x}\\", "a$b"]
)
def test_names_of_files_are_not_interpolated(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["predict", f"video={name}"])
    arrange(literal=("video",))
    override = OverridesParser.create().parse_override(sys.argv[1])
    assert OmegaConf.to_container(OmegaConf.create({"video": override.value()}), resolve=True) == {"video": name}


def test_a_path_that_needs_quotes(command: Callable[..., Ended], tmp_path: Path) -> None:
    told = """quote it for Hydra too: 'checkpoint="odd/epoch=9-step=350.ckpt"')."""
    refused(command("evaluate", "checkpoint=odd/epoch=9-step=350.ckpt"), told, tmp_path)
    refused(command("evaluate", "checkpoint="), "checkpoint = '' is wrong: it is empty, as an unset variable", tmp_path)


def test_two_ablations_of_one_run(train: Callable[..., Ended], tmp_path: Path) -> None:
    told = "ablation is given twice: choose one, or write +ablation=no_entropy,image_stn -m to run each."
    refused(train("+ablation=no_entropy", "+ablation=image_stn"), told, tmp_path)


APEX = ("model=apex", "data=p2d", "scale=smoke")


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("model.hidden=1000000", "model (apex_lab.models.apex.Apex) asks for 12,000.1 GB at once, and"),
        (
            "model.start_mask=1e308",
            "model.start_mask = 1e+308 is wrong: no number in single precision is above 3.40282e+38 in size.",
        ),
        ("model.encoder.depths=[100,100,100,100]", "model.encoder: it has more than 20,000 parts"),
        ("model.background.image_size=64", "model.background.image_size=64 must be that of the model, 32."),
        ("model.image_size=48", "model.image_size=48 must be a multiple of 32, its quarter one of model.grid=4"),
        ("model.merges=-1", "model.merges = -1 is wrong: input should be greater than or equal to 0."),
        ("model.background.shadow=0", "model.background.shadow = 0 is wrong: input should be greater than 0."),
        (
            "model.background.shadow=1.5",
            "model.background.shadow = 1.5 is wrong: input should be less than or equal to 1.",
        ),
        ("schedule.temperature.end=0", "schedule.temperature is 0 at step"),
        ("++schedule.carry.end=2", "schedule.carry is 2 at step 0: it must be between 0 and 1."),
        ("loss.nll=-1", "loss.nll is -1 at step 0: it must be at least 0."),
    ],
)
def test_values_that_apex_cannot_be_trained_with(
    word: str, told: str, command: Callable[..., Ended], tmp_path: Path
) -> None:
    steps = ("schedule.temperature.steps=2",) if "temperature" in word else ()
    refused(command("train", *APEX, word, *steps), told, tmp_path)


def test_apex_may_be_built_for_another_size_than_the_data_have(
    command: Callable[..., Ended], the_run: Callable[..., Path]
) -> None:
    words = ("trainer.max_steps=1", "model.image_size=64", "evaluation.pictures=0")
    ended = command(
        "train", "--config-dir", str(REPOSITORY / "tests" / "conf"), "model=apex", "data=squares", "scale=smoke", *words
    )
    assert ended.code == 0
    assert (the_run() / "metrics.json").is_file()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("+ablation=no_entropy",), "ablation=no_entropy is for training: a checkpoint brings its own configuration"),
        (("+scale=cpu",), "scale=cpu is for training"),
        (("++evaluation.videos=4",), "evaluation.* are keys of training: here write videos=4."),
    ],
)
def test_what_belongs_to_training_is_told_so_by_evaluate(
    words: tuple[str, ...], told: str, command: Callable[..., Ended], tmp_path: Path
) -> None:
    refused(command("evaluate", "checkpoint=x.ckpt", *words), told, tmp_path)


def test_hydra_s_own_keys_can_be_set(train: Callable[..., Ended], tmp_path: Path) -> None:
    refused(train("++hydra.job.env_set.COLOUR=red", "hydra.verbose=false", "seed=x"), "seed = 'x' is wrong", tmp_path)


def test_a_sweep_without_the_option_m(train: Callable[..., Ended], tmp_path: Path) -> None:
    refused(train("hydra.mode=MULTIRUN", "seed=0,x"), "seed = 'x' is wrong", tmp_path)


def test_a_gpu_that_is_not_there(train: Callable[..., Ended], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    refused(train("trainer=gpu"), "PyTorch finds no CUDA device: use trainer=cpu or trainer=auto.", tmp_path)


def test_the_option_m_may_stand_anywhere(train: Callable[..., Ended], tmp_path: Path) -> None:
    refused(train("seed=0", "-m", "trainer.max_steps=5,x"), "trainer.max_steps = 'x' is wrong", tmp_path)


@pytest.mark.parametrize("words", [("--help",), ("--cfg", "job", "--resolve"), ("--info", "defaults")])
def test_hydra_s_own_questions_are_answered(
    words: tuple[str, ...], command: Callable[..., Ended], tmp_path: Path
) -> None:
    ended = command("train", *TINY, *words)
    assert ended.code == 0
    assert "max_steps: 6" in ended.out or "scale" in ended.out
    assert list(tmp_path.iterdir()) == []


def test_a_configuration_folder_that_is_not_there(command: Callable[..., Ended], tmp_path: Path) -> None:
    refused(command("train", "--config-dir", "nowhere"), "--config-dir nowhere is not a folder.", tmp_path)
