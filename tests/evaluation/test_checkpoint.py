"""Evaluation of checkpoints from the command line: what is stored, gone on with, told."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filelock import FileLock

from apex_lab.base.interrupts import Interrupted
from apex_lab.evaluation import EXPORTS, export_path
from apex_lab.inference.predictor import Predictor
from apex_lab.metrics import KEYS
from tests.evaluation.conftest import Ask, Make
from tests.tiny import Layers, SquaresSource


def stored(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "metrics.json").read_text())


def scores(folder: Path, split: str = "test") -> dict[str, Any]:
    """What must be equal for equal evaluations."""
    keys = ("videos", "frames", "foreground_share", "total", "per_video", "hota_alpha", "by_property", "seed")
    return {key: stored(folder)["splits"][split][key] for key in keys}


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The number of videos of every batch that a model is asked about; [-1] = n breaks the n-th batch off."""
    batches: list[int] = []
    plain = Predictor.__call__

    def counted(self: Predictor, batch: dict[str, Any], **options: Any) -> Any:
        batches.append(len(batch["index"]))
        return plain(self, batch, **options)

    monkeypatch.setattr(Predictor, "__call__", counted)
    return batches


def test_everything_is_stored(make_run: Make, ask: Ask) -> None:
    run = make_run()
    ended = ask(f"checkpoint={run}", "pictures=0")
    assert ended.code == 0, ended.err
    content = stored(run)
    test = content["splits"]["test"]
    assert (test["videos"], test["frames"], test["seed"], test["step"]) == (5, 15, 0, 6)
    assert set(test["total"]) == set(KEYS)
    assert [row["video"] for row in test["per_video"]] == [f"test_{i:05d}" for i in range(5)]
    assert test["settings"] == content["settings"]
    assert test["settings"]["scoring"]["tracking"]["first_frame"] == 0
    assert (test["settings"]["scoring"]["min_presence"], test["settings"]["scoring"]["presence_after"]) == (0.5, False)
    assert test["versions"] == content["versions"]
    assert test["data_fingerprint"] == test["data"]["fingerprint"] == SquaresSource(test=5).fingerprint
    assert test["labelled"] is True
    assert {row["property"] for row in test["by_property"]} == {"size"}
    with open(run / "per_video_test.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["ari"]) for row in rows] == [row["ari"] for row in test["per_video"]]
    with open(run / "objects_test.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == 5
    lines = [line.split() for line in ended.out.splitlines()]
    assert lines[1] == ["ARI-FG", "MSC-FG", "ARI", "MSC"]
    assert lines[3] == ["MOTA", "MOTP", "Match", "ID", "S.", "FPs", "Miss", "MD", "MT"]
    assert float(lines[4][0]) == round(test["total"]["mota"], 1)
    assert lines[5:] == [[str(run / "metrics.json")]]


def test_other_splits_stand_beside(make_run: Make, ask: Ask) -> None:
    run = make_run()
    assert ask(f"checkpoint={run}", "pictures=0").code == 0
    before = stored(run)["splits"]["test"]
    assert ask(f"checkpoint={run}", "pictures=0", "split=val").code == 0
    assert set(stored(run)["splits"]) == {"test", "val"}
    assert stored(run)["splits"]["test"] == before
    assert stored(run)["splits"]["val"]["per_video"][0]["video"] == "val_00000"


@pytest.mark.parametrize(
    ("words", "folder"),
    [
        (("videos=3",), "last_test_3"),
        (("scoring.tracking.first_frame=1",), "last_test_*"),
        (("checkpoint={}/checkpoints/best.ckpt",), "best_test"),
        (("checkpoint={}/checkpoints/early.ckpt",), "early_*_test"),
    ],
)
def test_what_is_not_for_tables_stays_out_of_the_run_s_metrics(
    words: tuple[str, ...], folder: str, make_run: Make, ask: Ask
) -> None:
    run = make_run()
    make_run(name="best")
    make_run(name="early", step=3)
    ended = ask(f"checkpoint={run}", "pictures=0", *(word.format(run) for word in words))
    assert ended.code == 0, ended.err
    assert not (run / "metrics.json").exists()
    (found,) = (run / "evaluate").glob(folder)
    assert stored(found)["splits"]["test"]["videos"] == (3 if "videos=3" in words else 5)


def test_settings_are_used_and_stored(make_run: Make, ask: Ask) -> None:
    run = make_run()
    words = ("scoring.tracking.first_frame=1", "scoring.public_first_frame=null", "scoring.min_presence=0.2")
    assert ask(f"checkpoint={run}", "pictures=0", "folder=here", *words).code == 0
    scored = stored(Path("here"))["splits"]["test"]
    assert scored["total"]["num_frames"] == 10
    assert not any(key.endswith("_start2") for key in scored["total"])
    assert scored["settings"]["scoring"]["tracking"]["first_frame"] == 1
    assert scored["settings"]["scoring"]["min_presence"] == 0.2


def test_checkpoints_in_any_order_give_the_same(make_run: Make, ask: Ask) -> None:
    runs = [make_run(seed=seed) for seed in (0, 1)]
    found = []
    for words in (f"checkpoint=[{runs[0]},{runs[1]}]", f"checkpoint=[{runs[1]},{runs[0]}]"):
        ended = ask(words, "pictures=0", "again=true")
        assert ended.code == 0, ended.err
        found.append([scores(run) for run in runs])
    assert found[0] == found[1]
    assert found[0][0]["total"] != found[0][1]["total"]
    assert [one["seed"] for one in found[0]] == [0, 1]


@pytest.mark.parametrize("word", ["outputs", "outputs/tiny_squares", "outputs/*/seed_*", "[outputs,outputs]"])
def test_folders_of_runs_and_patterns(word: str, make_run: Make, ask: Ask, asked: list[int]) -> None:
    runs = [make_run(seed=seed) for seed in (0, 1)]
    ended = ask(f"checkpoint={word}", "pictures=0", "videos=1")
    assert ended.code == 0, ended.err
    assert len(asked) == 2
    assert all((run / "evaluate" / "last_test_1" / "metrics.json").is_file() for run in runs)


def test_one_that_fails_does_not_stop_the_others(make_run: Make, ask: Ask) -> None:
    runs = [make_run(seed=seed) for seed in (0, 1)]
    with FileLock(str(runs[0] / ".lock")):
        ended = ask(f"checkpoint=[{runs[0]},{runs[1]}]", "pictures=0")
    assert ended.code == 1
    assert f"{runs[0]} is being worked on by another process" in ended.err
    listed = (
        f"1 of 2 checkpoints were not evaluated:\n  {runs[0]}/checkpoints/last.ckpt: {runs[0]} is being worked on by"
    )
    assert listed in ended.err
    assert (runs[1] / "metrics.json").is_file()
    assert not (runs[0] / "metrics.json").exists()


def test_killed_in_the_middle_it_resumes(
    make_run: Make, ask: Ask, asked: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, words = make_run(), ("pictures=0", "save_interval=2", "export=npz")
    unbroken = ask(f"checkpoint={run}", *words, "folder=unbroken")
    assert unbroken.code == 0
    assert asked == [2, 2, 1]
    asked.clear()
    plain = Predictor.__call__

    def killed(self: Predictor, batch: dict[str, Any], **options: Any) -> Any:
        if len(asked) == 1:
            raise Interrupted(15)
        return plain(self, batch, **options)

    with monkeypatch.context() as patch:
        patch.setattr(Predictor, "__call__", killed)
        assert ask(f"checkpoint={run}", *words).code == 128 + 15
    assert not (run / "metrics.json").exists()
    asked.clear()
    assert ask(f"checkpoint={run}", *words).code == 0
    assert asked == [2, 1]
    assert scores(run) == scores(Path("unbroken"))
    assert (run / "per_video_test.csv").read_bytes() == Path("unbroken/per_video_test.csv").read_bytes()
    exports = [dict(np.load(folder / "predictions" / "test.npz")) for folder in (run, Path("unbroken"))]
    assert exports[0].keys() == exports[1].keys()
    assert all(np.array_equal(exports[0][key], exports[1][key]) for key in exports[0])
    assert not list(run.glob(".test_*"))


@pytest.mark.parametrize("change", ["weights", "scoring", "videos"])
def test_what_was_begun_otherwise_is_not_mixed_in(
    change: str, make_run: Make, ask: Ask, asked: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, words = make_run(), ["pictures=0", "save_interval=1", "folder=here"]
    plain = Predictor.__call__
    with monkeypatch.context() as patch:

        def killed(self: Predictor, batch: dict[str, Any], **options: Any) -> Any:
            if len(asked) == 2:
                raise Interrupted(15)
            return plain(self, batch, **options)

        patch.setattr(Predictor, "__call__", killed)
        assert ask(f"checkpoint={run}", *words).code == 128 + 15
    asked.clear()
    if change == "weights":
        other = make_run(seed=1)
        (run / "checkpoints" / "last.ckpt").write_bytes((other / "checkpoints" / "last.ckpt").read_bytes())
    words += {"weights": [], "scoring": ["scoring.skip_empty=true"], "videos": ["videos=4"]}[change]
    assert ask(f"checkpoint={run}", *words).code == 0
    assert sum(asked) == (4 if change == "videos" else 5)


def test_what_was_done_is_not_done_again(make_run: Make, ask: Ask, asked: list[int]) -> None:
    run = make_run()
    first = ask(f"checkpoint={run}", "pictures=1")
    before, count = (run / "metrics.json").read_bytes(), len(asked)
    again = ask(f"checkpoint={run}", "pictures=1")
    assert again.out.splitlines()[0] == f"evaluated already (again=true does it once more): {run / 'metrics.json'}"
    assert again.out.splitlines()[6:8] == [str(run / "metrics.json"), str(run / "view" / "test" / "film_strip.png")]
    assert sorted(again.out.splitlines()[1:]) == sorted(first.out.splitlines())
    assert (len(asked), (run / "metrics.json").read_bytes()) == (count, before)
    assert ask(f"checkpoint={run}", "pictures=1", "again=true").code == 0
    assert len(asked) == 2 * count


def test_pictures_of_best_median_and_worst(make_run: Make, ask: Ask) -> None:
    run = make_run()
    ended = ask(f"checkpoint={run}", "pictures_by=msc")
    assert ended.code == 0, ended.err
    test = stored(run)["splits"]["test"]
    ranked = sorted(test["per_video"], key=lambda row: -row["msc"])
    wanted = [("best", ranked[0]), ("median", ranked[2]), ("worst", ranked[-1])]
    assert test["pictures"] == [{"title": t, "video": row["video"], "value": row["msc"]} for t, row in wanted]
    paths = [Path(line) for line in ended.out.splitlines()[5:]]
    view = run / "view" / "test"
    names = [f"components_{title}_{row['video']}.png" for title, row in wanted]
    assert paths == [run / "metrics.json", *(view / n for n in ("film_strip.png", "movie.mp4", "movie.gif", *names))]
    assert all(path.is_file() for path in paths)


def test_exports_score_as_the_model_does(make_run: Make, ask: Ask) -> None:
    run = make_run()
    for format in EXPORTS:
        ended = ask(f"checkpoint={run}", "pictures=0", f"export={format}")
        assert ended.code == 0, ended.err
        made = Path(ended.out.splitlines()[6])
        assert made.parent == run / "predictions"
        if format == "mot":
            assert len(list(made.glob("*.txt"))) == 5
            continue
        read = "coco" if format == "weis" else format
        truths = [
            f"truth={path}" for path in (export_path(run, "test", format, truth=True), made.with_name("test.npz"))
        ]
        for words in [[]] if format == "npz" else [[truth, f"format={read}"] for truth in truths]:
            ended = ask(f"predictions={made}", f"output={format}.json", *words)
            assert ended.code == 0, ended.err
            again = json.loads(Path(f"{format}.json").read_text())
            for name, value in scores(run)["total"].items():
                close = None if value is None else pytest.approx(value, abs=1e-9)
                assert again["total"][name] == close, (format, name)
            for here, there in zip(scores(run)["per_video"], again["per_video"], strict=True):
                assert there["hota"] == pytest.approx(here["hota"], abs=1e-9)
                assert here["video"] == there["video"]


def test_share_of_pixels_given_to_objects(make_run: Make, ask: Ask) -> None:
    run = make_run()
    assert ask(f"checkpoint={run}", "pictures=0", "export=npz").code == 0
    arrays = np.load(run / "predictions" / "test.npz")
    shares = []
    for video in range(5):
        masks, ids = (arrays[f"test_{video:05d}__{part}"] for part in ("masks", "ids"))
        shares.append(1 - (masks * (ids == 0)[..., None, None]).sum(axis=1).mean())
    assert scores(run)["foreground_share"] == pytest.approx(np.mean(shares), abs=1e-6)


def test_models_without_identities_get_no_tracking(make_run: Make, ask: Ask, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Layers, "tracks", False)
    run = make_run()
    ended = ask(f"checkpoint={run}", "pictures=1")
    assert ended.code == 0, ended.err
    assert "MOTA" not in ended.out
    test = stored(run)["splits"]["test"]
    assert test["settings"]["scoring"]["identities"] == "none"
    assert [test["total"][key] for key in ("mota", "hota", "video_ari", "idf1", "jf")] == [None] * 5
    assert test["total"]["ari"] is not None
    ended = ask(f"checkpoint={run}", "pictures=1", "pictures_by=mota", "folder=here")
    assert ended.code == 1
    assert "pictures_by = 'mota' is undefined for every video" in ended.err
    assert ask(f"checkpoint={run}", "pictures=0", "scoring.identities=linked", "folder=l").code == 0
    assert stored(Path("l"))["splits"]["test"]["total"]["mota"] is not None


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("pictures_by=ari_fq",), "pictures_by = 'ari_fq' ranks no videos; did you mean 'ari_fg'?"),
        (("export=avi",), "export = 'avi' is wrong: input should be 'npz', 'coco'"),
        (("export=npz", "scoring.resize=truth"), "scoring.resize = truth scores masks of the model's size"),
        (("scoring.tracking.min_iou=2",), "min_iou is 2.0; it must lie in (0, 1]."),
        (("scoring.tracking.first_frme=2",), "Unknown key scoring.tracking.first_frme = 2"),
        (("truth=a.npz",), "truth = 'a.npz' goes with predictions=... alone: leave it out."),
        (("predictions=a.npz",), "checkpoint and predictions are both given"),
        (("checkpoint=outputs/*/none",), "checkpoint = outputs/*/none fits nothing"),
        (("checkpoint=outputs/tiny_squares/seed_0/view",), "is a folder without checkpoints/last.ckpt, and no run"),
    ],
)
def test_impossible_wishes_are_refused_in_a_sentence(
    words: tuple[str, ...], told: str, make_run: Make, ask: Ask
) -> None:
    run = make_run()
    (run / "view").mkdir()
    ended = ask(f"checkpoint={run}", *words)
    assert ended.code == 2
    assert told in ended.err
    assert len(ended.err.splitlines()) == 1


def test_a_posterior_is_asked_of_models_that_have_one_alone(
    make_run: Make, ask: Ask, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run()
    ended = ask(f"checkpoint={run}", "scoring.masks=posterior")
    assert ended.code == 2
    files = f"{run}/checkpoints/last.ckpt"
    assert f"scoring.masks = posterior goes with mixture likelihoods alone: leave out {files}." in ended.err
    assert not (run / "evaluate").exists()
    monkeypatch.setattr(Layers, "has_posterior", True)
    monkeypatch.setattr(Layers, "posterior", lambda self, scene, video, context: scene.masks.flip(2))
    assert ask(f"checkpoint={run}", "pictures=0").code == 0
    assert ask(f"checkpoint={run}", "pictures=0", "scoring.masks=posterior").code == 0
    (folder,) = (run / "evaluate").glob("last_test_*")
    found = stored(folder)["splits"]["test"]
    assert found["settings"]["scoring"]["masks"] == "posterior"
    assert stored(run)["splits"]["test"]["settings"]["scoring"]["masks"] == "model"
    assert found["total"]["ari"] == pytest.approx(scores(run)["total"]["ari"])  # a flip renames components
    assert found["foreground_share"] != scores(run)["foreground_share"]  # but another one is the background


def test_what_no_weight_depends_on_can_be_changed(make_run: Make, ask: Ask, monkeypatch: pytest.MonkeyPatch) -> None:
    """A model with two more components, which here are of other weights: the mechanism alone."""
    run = make_run()
    ended = ask(f"checkpoint={run}", "model.width=3")
    assert ended.code == 2
    assert "model.width = 3 cannot be changed for trained weights: nothing of this model can." in ended.err
    built: list[int] = []
    start = Layers.__init__

    def watched(self: Layers, components: int = 2, width: int = 8, extra: int = 0) -> None:
        built.append(extra)
        start(self, components, width)

    monkeypatch.setattr(Layers, "__init__", watched)
    monkeypatch.setattr(Layers, "changeable", ("extra",))
    ended = ask(f"checkpoint={run}", "model.width=3")
    assert "model.width = 3 cannot be changed for trained weights: only extra can." in ended.err
    assert ask(f"checkpoint={run}", "model.extra=many").code == 2
    built.clear()
    assert ask(f"checkpoint={run}", "pictures=0", "model.extra=5").code == 0
    assert 5 in built
    (folder,) = (run / "evaluate").glob("last_test_*")
    assert stored(folder)["splits"]["test"]["settings"]["model"] == {"extra": 5}
    assert not (run / "metrics.json").exists()
