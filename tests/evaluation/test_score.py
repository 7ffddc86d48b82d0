"""Scoring, ranking and printing, each alone."""

from __future__ import annotations

import dataclasses
import math
import pickle
import re
import weakref
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
import yaml
from jaxtyping import Float
from torch import Tensor
from torch.utils.data import DataLoader, Subset, default_collate

from apex_lab.base.errors import UserError
from apex_lab.evaluation import Parts, Predicted, ScoringPart, score, summary
from apex_lab.evaluation.pictures import choose
from apex_lab.evaluation.score import predict
from apex_lab.inference.predictor import Predictor
from apex_lab.metrics import Evaluator, EvaluatorSettings
from apex_lab.metrics.objects import ObjectMetadata, p2d_metadata
from apex_lab.metrics.page import page
from apex_lab.scene import Context, Scene
from tests.conftest import REPOSITORY
from tests.tiny import Layers, Squares

CPU = torch.device("cpu")


class Watched(Layers):
    """Knows how many of its answers are still in memory."""

    def __init__(self) -> None:
        super().__init__()
        self.answers: list[weakref.ref[Scene]] = []
        self.alive: list[int] = []

    def forward(self, video: Float[Tensor, "B T 3 H W"], context: Context) -> Scene:
        self.alive.append(sum(answer() is not None for answer in self.answers))
        scene = super().forward(video, context)
        self.answers.append(weakref.ref(scene))
        return scene


def test_memory_does_not_grow_with_videos() -> None:
    model = Watched()
    loader = DataLoader(Squares("test", 24, 3, 32, 0), batch_size=2)
    tally = score(Predictor(model, {}, CPU), loader, ScoringPart())
    assert len(tally) == 24
    assert max(model.alive) <= 1
    assert len(pickle.dumps(tally)) / 24 < 10_000


def test_batch_size_and_order_change_no_digit() -> None:
    predictor = Predictor(Layers(), {}, CPU)
    data = Squares("test", 6, 3, 32, 0)
    mixed = DataLoader(Subset(data, [3, 1, 5, 0, 4, 2]), batch_size=4)
    found = [
        score(predictor, loader, ScoringPart()).evaluator.result() for loader in (DataLoader(data, batch_size=1), mixed)
    ]
    assert found[0]["total"] == pytest.approx(found[1]["total"], rel=1e-12, nan_ok=True)
    assert [row["video"] for row in found[0]["per_video"]] == [row["video"] for row in found[1]["per_video"]]


class HalfSize(Layers):
    """Sees 16 x 16 pixels; the left 5 columns are one component."""

    input_size = (16, 16)

    def forward(self, video: Float[Tensor, "B T 3 H W"], context: Context) -> Scene:
        scene = super().forward(video, context)
        left = torch.zeros_like(scene.masks)
        left[:, :, 1, :, :5] = 1
        left[:, :, 0, :, 5:] = 1
        return dataclasses.replace(scene, masks=left)


def test_masks_go_to_the_size_of_the_truth_or_the_truth_to_theirs() -> None:
    """op3.md section 7: soft masks upsampled before the argmax, or labels shrunk by nearest neighbour."""
    data = Squares("test", 2, 3, 32, 0)
    predictor = Predictor(HalfSize(), {}, CPU)
    batch = default_collate([data[0], data[1]])
    small = list(predict(predictor, batch, ScoringPart(resize="truth")))
    large = list(predict(predictor, batch, ScoringPart()))
    assert small[0].identities.shape == (3, 16, 16)
    assert large[0].identities.shape == (3, 32, 32)
    assert (small[0].identities[..., :5] == 1).all()
    by_hand = Evaluator(ScoringPart().settings(True))
    for i, predicted in enumerate(small):
        labels = F.interpolate(data[i]["segmentation"][:, None].double(), size=(16, 16), mode="nearest-exact")[:, 0]
        by_hand.add(predicted.name, predicted.identities, labels.long().numpy(), None, set(predicted.backgrounds))
    found = score(predictor, DataLoader(data, batch_size=2), ScoringPart(resize="truth")).evaluator.result()["total"]
    assert found == pytest.approx(by_hand.result()["total"], nan_ok=True)
    usual = score(predictor, DataLoader(data, batch_size=2), ScoringPart()).evaluator.result()["total"]
    assert found["ari"] != pytest.approx(usual["ari"], abs=1e-6)


class Labelled(Squares):
    """Squares with the labels of P2D: one object in slot 0, touched by the arm in frame 1."""

    def metadata(self, video: int) -> ObjectMetadata:
        contact = np.zeros((3, 1), dtype=bool)
        contact[1] = True
        pixels = np.array([[0, 64]] * 3)
        meta = {
            "names": ["mug"],
            "classes": np.array([4]),
            "visible_px": pixels,
            "amodal_px": pixels * 2,
            "arm_contact": contact,
            "object_contact": np.zeros((3, 1, 1), dtype=bool),
        }
        return p2d_metadata(meta)


def test_what_the_data_set_knows_of_objects_is_in_the_table() -> None:
    loader = DataLoader(Subset(Labelled("val", 3, 3, 32, 0), range(2)), batch_size=2)
    table = score(Predictor(Layers(), {}, CPU), loader, ScoringPart()).evaluator.result()["per_object"]
    assert table["video"].tolist() == ["val_00000", "val_00001"]
    assert table["class"].tolist() == ["mug"] * 2
    assert table["occlusion"].tolist() == [0.5] * 2
    assert table["contact"].tolist() == pytest.approx([1 / 3] * 2)


class Nameless(Layers):
    """Gives no identity to any component."""

    def forward(self, video: Float[Tensor, "B T 3 H W"], context: Context) -> Scene:
        scene = super().forward(video, context)
        return dataclasses.replace(scene, ids=torch.full_like(scene.ids, -1))


def test_a_model_s_malformed_output_is_refused_by_name() -> None:
    with pytest.raises(UserError, match=r"The model's output for val_00000 cannot be scored: 100.00% of"):
        score(Predictor(Nameless(), {}, CPU), DataLoader(Squares("val", 2, 3, 32, 0), batch_size=2), ScoringPart())


def test_damaged_parts_are_told(tmp_path: Path) -> None:
    parts = Parts(tmp_path / "parts", 2)
    identities = np.arange(24, dtype=np.int64).reshape(2, 3, 4)
    saved = [
        Predicted("a", 0, identities, frozenset({0, 3}), math.nan, 1.5, {"error": 2.25}),
        Predicted("b", 1, identities[:1] - 1, frozenset(), 0.25, 0.0),
    ]
    parts.save(saved)
    for one, other in zip(parts, saved, strict=True):
        assert np.array_equal(one.identities, other.identities)
        assert one.share == pytest.approx(other.share, rel=0, nan_ok=True)
        kept = ("name", "position", "backgrounds", "present", "terms")
        assert all(getattr(one, name) == getattr(other, name) for name in kept)
    whole = (tmp_path / "parts" / "000000.npz").read_bytes()
    for damaged in (b"nothing", b"", whole[: len(whole) // 2], whole[:-30]):
        (tmp_path / "parts" / "000000.npz").write_bytes(damaged)
        with pytest.raises(UserError, match=r"000000.npz is damaged .* remove .*parts and run the command again"):
            list(parts)
    with pytest.raises(UserError, match=r"000000.npz is damaged .* remove .*parts and run the command again"):
        list(parts)
    parts.remove()
    assert not (tmp_path / "parts").exists()


def test_parts_whose_removal_was_killed_are_the_first_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parts = Parts(tmp_path / "parts", 1)
    for number in range(3):
        parts.save([Predicted(str(number), number, np.zeros((1, 2, 2), np.int64), frozenset(), 0.5, 0.0)])
    unlink, removed = Path.unlink, []

    def killed(path: Path, missing_ok: bool = False) -> None:
        if removed:
            raise KeyboardInterrupt
        removed.append(path.name)
        unlink(path, missing_ok)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "unlink", killed)
        with pytest.raises(KeyboardInterrupt):
            parts.remove()
    assert [one.position for one in parts] == [0, 1]
    parts.remove()
    assert list(tmp_path.iterdir()) == []


def test_videos_are_ranked() -> None:
    rows = [{"video": f"v{i}", "ari": value, "fps": 10 * value} for i, value in enumerate((0.5, 0.1, 0.9, 0.7, 0.3))]
    rows.append({"video": "undefined", "ari": math.nan, "fps": math.nan})
    assert [(c.title, c.video) for c in choose(rows, 3, "ari")] == [("best", "v2"), ("median", "v0"), ("worst", "v1")]
    assert [(c.title, c.video, c.value) for c in choose(rows, 2, "fps")] == [("best", "v1", 1), ("worst", "v2", 9)]
    assert [(c.title, c.video) for c in choose(rows, 1, "ari")] == [("median", "v0")]
    titles = [c.title for c in choose(rows, 9, "ari")]
    assert titles == ["best", "rank 2", "median", "rank 4", "worst"]
    assert choose(rows, 0, "ari") == []
    assert choose([], 3, "ari") == []


def test_rows_for_the_terminal() -> None:
    total = {"videos": 2, "frames": 6, "ari_fg": -0.0001, "msc_fg": 0.25, "ari": 1.0, "msc": None}
    lines = summary("val", total).splitlines()
    assert lines[0] == "val: 2 videos, 6 frames"
    assert lines[2].split() == ["0.000", "0.250", "1.000", "n/a"]
    assert len(lines) == 3
    tracked = {**total, "mota": -48.64, "motp": None, "match": 25.7}
    assert summary("val", tracked).splitlines()[4].split()[:3] == ["-48.6", "n/a", "25.7"]


def test_the_file_s_scoring_is_that_of_training() -> None:
    stored = yaml.safe_load((REPOSITORY / "conf" / "evaluate.yaml").read_text())["scoring"]
    assert ScoringPart.model_validate(stored) == ScoringPart()
    assert ScoringPart().settings(tracks=True) == EvaluatorSettings()
    assert ScoringPart().settings(tracks=False) == EvaluatorSettings(identities="none")


def test_sections_that_docstrings_cite_are_on_the_page() -> None:
    headings = set(re.findall(r"^##+ (\d(?:\.\d)?)[. ]", page(), flags=re.MULTILINE))
    assert headings >= {"0", "1", "1.1", "1.2", "1.3", "2", "2.1", "2.2", "2.3", "2.4", "3", "4", "5", "6", "7"}
    cited = 0
    for folder in ("src", "sims"):
        for file in (REPOSITORY / folder).rglob("*.py"):
            for numbers in re.findall(r"metrics\.md\s+sections? ([\d., and]+)", file.read_text()):
                for number in re.findall(r"\d(?:\.\d)?", numbers.split(", step")[0]):
                    assert number in headings, (file, number)
                    cited += 1
    assert cited > 15


def test_the_page_of_keys_is_current() -> None:
    told = "run `python -m apex_lab.metrics.page > docs/metrics.md`"
    assert (REPOSITORY / "docs" / "metrics.md").read_text() == page(), told


class Mixture(Layers):
    """Its posterior shifts components by one."""

    has_posterior = True

    def posterior(
        self, scene: Scene, video: Float[Tensor, "B T 3 H W"], context: Context
    ) -> Float[Tensor, "B T K H W"]:
        return scene.masks.roll(1, dims=2)


def test_a_posterior_takes_the_place_of_the_masks_and_changes_nothing_else() -> None:
    batch = next(iter(DataLoader(Squares("val", 2, 3, 32, 0), batch_size=2)))
    model = Mixture()
    plain, shifted = (Predictor(model, {}, CPU, posterior=posterior)(batch) for posterior in (False, True))
    torch.testing.assert_close(shifted.masks, plain.masks.roll(1, dims=2))
    torch.testing.assert_close(shifted.reconstruction, plain.reconstruction)
    assert (shifted.segmentation() == (plain.segmentation() + 1) % 3).all()
