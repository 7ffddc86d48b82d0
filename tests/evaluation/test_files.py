"""Which checkpoints are meant, those that cannot be evaluated among them, and what an evaluation may remove."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from apex_lab.base.errors import UserError
from apex_lab.base.interrupts import Interrupted
from apex_lab.base.signed import is_signed
from apex_lab.config import components
from apex_lab.config.schema import PathsPart
from apex_lab.evaluation import files
from apex_lab.evaluation.partial import MARKER, Parts
from apex_lab.inference.predictor import Predictor
from apex_lab.runs import checkpoints
from tests.conftest import REPOSITORY
from tests.evaluation.conftest import Ask, Make

SHIPPED = REPOSITORY / "sweeps" / "results" / "apex_p2d_cpu.ckpt"


def last(run: Path) -> Path:
    return run / "checkpoints" / "last.ckpt"


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-100])


def flip(file: Path) -> None:
    """Another bit in a weight: the pickled part is as it was."""
    stored = torch.load(file, weights_only=True)
    weights = stored.get("inference", stored)["weights"]  # format 1 had no such entry
    largest = max(weights.values(), key=torch.numel).numpy().tobytes()
    content = bytearray(file.read_bytes())
    content[content.index(largest) + 3] ^= 64
    file.write_bytes(content)


def change(file: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    content = torch.load(file, weights_only=True)
    edit(content)
    torch.save(content, file)


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "cut": (cut, "is no checkpoint, or its end is missing"),
    "empty": (lambda file: file.write_bytes(b""), "is no checkpoint, or its end is missing"),
    "text": (lambda file: file.write_text("text"), "is no checkpoint, or its end is missing"),
    "folder": (lambda file: (file.unlink(), file.mkdir()), "There is no checkpoint at"),
    "broken link": (lambda file: (file.unlink(), file.symlink_to("nowhere")), "There is no checkpoint at"),
    "bit of a weight": (flip, "is damaged (checksum of"),
    "not finite": (
        lambda file: change(file, lambda c: c["inference"]["weights"]["base"].fill_(float("nan"))),
        "holds weights that are not finite (base)",
    ),
    "other program's": (lambda file: torch.save({"state_dict": {}}, file), "is no apex_lab checkpoint"),
    "no configuration": (lambda file: change(file, lambda c: c.update(config=None)), "(its config is none)"),
    "empty configuration": (lambda file: change(file, lambda c: c.update(config={})), "no whole configuration"),
    "no inference": (lambda file: change(file, lambda c: c["inference"].pop("model")), "(its inference.model is none)"),
    "weights are text": (
        lambda file: change(file, lambda c: c["inference"]["weights"].update(base="text")),
        "(its weight base is no tensor)",
    ),
    "other weights": (
        lambda file: change(file, lambda c: c["inference"]["weights"].pop("base")),
        "The weights do not fit their model",
    ),
    "newer": (lambda file: change(file, lambda c: c.update(format=99)), "has format 99"),
    "another version's": (
        lambda file: change(file, lambda c: c["config"]["trainer"].update(speed=3)),
        "holds a configuration that this version of apex_lab refuses: Unknown key trainer.speed = 3",
    ),
    "another version's model": (
        lambda file: change(file, lambda c: c["config"]["model"].update(depth=3)),
        "holds a configuration that this version of apex_lab refuses: Unknown key model.depth = 3",
    ),
}


def test_bad_checkpoints_among_good_ones_are_listed_at_the_end(make_run: Make, ask: Ask) -> None:
    good = [make_run(seed=seed) for seed in (1, 100)]
    bad = {damage: make_run(seed=2 + number) for number, damage in enumerate(DAMAGES)}
    for damage, run in bad.items():
        DAMAGES[damage][0](last(run))
    ended = ask("checkpoint=outputs", "pictures=0", "videos=1")
    assert ended.code == 1, ended.err
    lines = ended.err.splitlines()
    head = lines.index(f"{len(bad)} of {len(bad) + 2} checkpoints were not evaluated:")
    listed = lines[head + 1 :]
    for damage, run in bad.items():
        (line,) = [line for line in listed if str(last(run)) in line]
        assert DAMAGES[damage][1] in line, damage
        assert not (run / "evaluate").exists(), damage
    assert len(listed) == len(bad)
    for run in good:
        assert (run / "evaluate" / "last_test_1" / "metrics.json").is_file()


def test_an_exception_among_several_stops_none(make_run: Make, ask: Ask, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = [make_run(seed=seed) for seed in (0, 1)]
    plain = Predictor.__call__

    def sick(self: Predictor, batch: dict[str, Any], **options: Any) -> Any:
        if self.seed == 0:
            raise RuntimeError("sizes do not fit")
        return plain(self, batch, **options)

    monkeypatch.setattr(Predictor, "__call__", sick)
    ended = ask("checkpoint=outputs", "pictures=0")
    assert ended.code == 1
    told = re.escape(f"evaluated:\n  {last(runs[0])}: RuntimeError: sizes do not fit")
    assert re.search(rf"{told} \(traceback: \S+\.log\)\.\n$", ended.err)
    assert (runs[1] / "metrics.json").is_file()


def test_where_none_can_be_read_nothing_starts(make_run: Make, ask: Ask) -> None:
    runs = [make_run(seed=seed) for seed in (0, 1)]
    for run in runs:
        cut(last(run))
    ended = ask("checkpoint=outputs", "pictures=0")
    assert ended.code == 2
    assert ended.err.startswith("2 of 2 checkpoints were not evaluated:\n  outputs/tiny_squares/seed_0/")
    ended = ask(f"checkpoint={runs[0]}", "pictures=0")
    assert (ended.code, len(ended.err.splitlines())) == (2, 1)


def test_settings_of_other_data_that_no_checkpoint_takes_are_refused_at_once(make_run: Make, ask: Ask) -> None:
    for seed in (0, 1):
        make_run(seed=seed)
    ended = ask("checkpoint=outputs", "data.test=0")
    assert ended.code == 2
    assert "data.test = 0 is wrong" in ended.err


def test_a_pattern_may_fit_runs_without_checkpoints(make_run: Make, ask: Ask) -> None:
    run = make_run(seed=1)
    empty = run.with_name("seed_0")
    empty.mkdir()
    ended = ask("checkpoint=outputs/*/seed_*", "pictures=0")
    assert ended.code == 1
    assert f"1 of 2 checkpoints were not evaluated:\n  checkpoint = {empty} is a folder without" in ended.err
    assert (run / "metrics.json").is_file()


def test_checkpoints_are_in_natural_order(make_run: Make) -> None:
    for seed in (10, 2, 1):
        make_run(seed=seed)
    for step in (100, 20, 3):
        make_run(name=f"step_{step}")
    for pattern in ("outputs", "outputs/*/seed_*"):
        found, bad = files.find([pattern])
        assert [path.parent.parent.name for path in found] == ["seed_1", "seed_2", "seed_10"], pattern
        assert bool(bad) == (pattern != "outputs")
    assert [path.stem for path in files.find(["outputs/*/seed_0/checkpoints/*.ckpt"])[0]] == [
        *("step_3", "step_20", "step_100"),
    ]


def test_checkpoints_are_looked_at_once_without_building_anything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = [tmp_path / f"{number}.ckpt" for number in range(3)]
    for file in found:
        file.write_bytes(SHIPPED.read_bytes())
    flip(found[0])
    looked: list[Path] = []
    plain = checkpoints.glance
    monkeypatch.setattr(checkpoints, "glance", lambda file, trusted: (looked.append(file), plain(file, trusted))[1])
    monkeypatch.setattr(components, "build", lambda *_, **__: pytest.fail("something was built"))
    monkeypatch.setattr(torch, "isfinite", lambda _: pytest.fail("weights were read"))
    paths = PathsPart(outputs="outputs", data="data")
    assert files.look(found, paths) == files.look(found, paths) == (found, {})
    assert looked == found
    cut(found[2])
    good, bad = files.look(found, paths)
    assert (good, list(bad), looked) == (found[:2], [found[2]], [*found, found[2]])


FOREIGN = (".test_mine", ".test_0123456789abcdef", ".val_mine", "parts", ".part")


def test_other_people_s_files_are_never_removed(make_run: Make, ask: Ask) -> None:
    run, here = make_run(), Path("here")
    for name in FOREIGN:
        (here / name).mkdir(parents=True)
        (here / name / "000000.npz").write_text("mine")
    theirs = [
        *("view/test/components_mine.png", "view/test/components_photo.png", "predictions/.test.npz.backup"),
        *("predictions/test.davis/test_00000/00007.png", "predictions/test.davis/.test_00000/notes.txt"),
        *("predictions/test.davis/test_00000/notes.txt", ".metrics.json.old", ".metrics.json.7.part"),
    ]
    for name in theirs:
        (here / name).parent.mkdir(parents=True, exist_ok=True)
        (here / name).write_text("mine")
    Image.new("RGB", (4, 4)).save(here / "view/test/components_photo.png")
    for words in (("export=davis", "pictures=1"), ("export=npz", "pictures=0", "again=true")):
        ended = ask(f"checkpoint={run}", "folder=here", *words)
        assert ended.code == 0, ended.err
    for name in FOREIGN:
        assert (here / name / "000000.npz").read_text() == "mine"
    for name in theirs:
        assert (here / name).is_file(), name
    made = list((here / "view" / "test").glob("components_median_*.png"))
    assert len(made) == 1
    assert is_signed(made[0])
    made[0].rename(made[0].with_name("components_old.png"))
    assert ask(f"checkpoint={run}", "folder=here", "pictures=1").code == 0
    assert made[0].exists()
    assert not made[0].with_name("components_old.png").exists()  # a picture of ours that is no longer asked for


def test_what_is_left_of_another_evaluation_is_removed(
    make_run: Make, ask: Ask, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run()
    calls = []
    plain = Predictor.__call__

    def killed(self: Predictor, batch: dict[str, Any], **options: Any) -> Any:
        calls.append(1)
        if len(calls) == 2:
            raise Interrupted(15)
        return plain(self, batch, **options)

    with monkeypatch.context() as patch:
        patch.setattr(Predictor, "__call__", killed)
        assert ask(f"checkpoint={run}", "folder=here", "pictures=0", "save_interval=1").code == 128 + 15
    (left,) = Path("here").glob(".test_*")
    assert (left / MARKER).is_file()
    (left / "mine.txt").write_text("mine")
    assert ask(f"checkpoint={run}", "folder=here", "pictures=0", "videos=1").code == 0
    assert [path.name for path in left.iterdir()] == ["mine.txt"]


def test_a_folder_of_somebody_else_takes_no_parts(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "000000.npz").write_text("mine")
    parts = Parts(tmp_path / "parts", 1)
    assert list(parts) == []
    with pytest.raises(UserError, match="holds files that apex_lab did not write: move them elsewhere"):
        parts.save([])
    parts.remove()
    assert (tmp_path / "parts" / "000000.npz").read_text() == "mine"
    (tmp_path / "link").symlink_to(tmp_path / "parts")
    (tmp_path / "parts" / MARKER).touch()
    Parts(tmp_path / "link", 1).remove()
    assert (tmp_path / "parts" / "000000.npz").read_text() == "mine"


@pytest.mark.parametrize(
    ("root", "trusted", "makes"), [("/data", False, True), ("/x", False, False), ("/x", True, True)]
)
def test_a_checkpoint_does_not_choose_where_data_are_made(root: str, trusted: bool, makes: bool) -> None:
    for name in ("P2DSource", "OwnVideosSource", "SpritesSource", "ArrangementSource"):
        node = {"_target_": f"apex_lab.data.{name}", "root": root}
        stored = {"data": node, "paths": {"data": "/data", "outputs": "o"}}
        found = files.here(Path("a.ckpt"), stored, PathsPart(outputs="runs", data="mine"), trusted)["data"]
        assert found.get("generate", True) is makes
        assert found["root"] == ("mine" if root == "/data" else root)
    # what makes nothing has no such key
    stored["data"] = {"_target_": "apex_lab.data.SketchySource", "root": root}
    assert "generate" not in files.here(Path("a.ckpt"), stored, PathsPart(outputs="runs", data="mine"), trusted)["data"]
