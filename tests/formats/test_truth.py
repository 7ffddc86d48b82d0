"""Ground truth from a P2D folder, which a stand-in for the simulator has made."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from apex_lab.base.errors import UserError
from apex_lab.data import P2D
from apex_lab.formats import PredictedVideo, open_truth, open_writer, p2d_video_name, score_predictions
from tests.fakes.p2d_tools import make, small


@pytest.fixture(scope="module")
def p2d(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("p2d")
    make(root, small(test=3, frames=4, image_size=32))
    return root


def export(root: Path, path: Path, format: str, split: str = "test") -> Path:
    """The ground truth itself as predictions."""
    data = P2D(root, split)
    with open_writer(format, path) as writer:
        for index in range(len(data)):
            writer.add(PredictedVideo(p2d_video_name(split, index), data[index]["segmentation"].numpy()))
    return path


@pytest.mark.parametrize("format", ["npz", "coco", "davis", "mots"])
def test_predictions_for_p2d(p2d: Path, tmp_path: Path, format: str) -> None:
    path = export(p2d, tmp_path / ("p" + {"npz": ".npz", "coco": ".json"}.get(format, "")), format)
    result = score_predictions(path, truth=p2d)
    assert result["total"]["videos"] == 3
    assert {result["total"][name] for name in ("ari", "ari_fg", "msc", "msc_fg", "hota", "jf", "idf1")} == {1.0}
    assert [row["video"] for row in result["per_video"]] == ["test_00000", "test_00001", "test_00002"]


def test_objects_come_with_their_classes(p2d: Path, tmp_path: Path) -> None:
    table = score_predictions(export(p2d, tmp_path / "p.npz", "npz"), truth=p2d)["per_object"]
    names = P2D(p2d, "test").meta(0)["names"]
    first = table[table["video"] == "test_00000"].set_index("label")["class"]
    assert first.loc[1] == "arm"
    assert all(first.loc[label] == names[label - 2] for label in first.index if label > 1)
    hidden = table["occlusion"].to_numpy(dtype=float)
    assert ((hidden >= 0) & (hidden <= 1)).all()
    assert table["contact"].notna().all()


def test_another_split(p2d: Path, tmp_path: Path) -> None:
    path = export(p2d, tmp_path / "p.npz", "npz", split="val")
    assert score_predictions(path, truth=p2d, split="val")["total"]["videos"] == 2
    with pytest.raises(UserError, match="video 'val_00000' has no ground truth, which has test_00000"):
        score_predictions(path, truth=p2d)
    with pytest.raises(UserError, match="no split 'none'"):
        open_truth(p2d, "none")


def test_labels_are_the_stored_ones(p2d: Path) -> None:
    truth = open_truth(p2d)
    np.testing.assert_array_equal(truth.labels("test_00002"), P2D(p2d, "test")[2]["segmentation"].numpy())


def test_what_holds_no_truth_is_refused(tmp_path: Path) -> None:
    (tmp_path / "truth.json").write_text("[]")
    for path in (tmp_path, tmp_path / "truth.json"):
        with pytest.raises(UserError, match="holds no ground truth: want an"):
            open_truth(path)
