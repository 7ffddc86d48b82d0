from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from apex_lab.metrics import Evaluator, ObjectMetadata, by_property, p2d_metadata
from apex_lab.metrics.objects import COLUMNS


def metadata(frames: int) -> ObjectMetadata:
    """An arm and two of three slots in use; the object of slot 2 half hidden in frame 0 and touched in frame 1."""
    visible = np.full((frames, 4), 10)
    amodal = visible.copy()
    visible[0, 3], amodal[:, 2] = 5, 0
    arm_contact, object_contact = np.zeros((frames, 3), dtype=bool), np.zeros((frames, 3, 3), dtype=bool)
    arm_contact[1, 2] = True
    return p2d_metadata(
        {
            "names": ["cup", "drill"],
            "classes": np.array([4, -1, 2]),
            "visible_px": visible,
            "amodal_px": amodal,
            "arm_contact": arm_contact,
            "object_contact": object_contact,
        }
    )


def test_p2d_metadata() -> None:
    found = metadata(2)
    assert found.labels.tolist() == [1, 2, 4]
    assert list(found.classes) == ["arm", "cup", "drill"]
    assert found.occlusion.tolist() == [[0, 0, 0.5], [0, 0, 0]]
    assert found.contact.tolist() == [[False, False, False], [True, False, True]]


def test_rows_of_one_video(make) -> None:
    truth = make.strip([0, 1, 2, 4], [0, 1, 2, 4], [0, 1, 2, 2])
    found = make.strip([9, 1, 2, 4], [9, 1, 7, 4], [9, 1, 9, 2])
    evaluator = Evaluator()
    evaluator.add("a", found, truth, metadata(3))
    table = evaluator.result()["per_object"]
    assert list(table.columns) == ["video", *COLUMNS]
    table = table.set_index("label")
    assert table["class"].to_dict() == {1: "arm", 2: "cup", 4: "drill"}
    assert table["frames"].tolist() == [3, 3, 2]
    assert table["area_px"].tolist() == [8, pytest.approx(32 / 3), 8]
    assert table["size"].tolist() == [0.25, pytest.approx(1 / 3), 0.25]
    assert table["occlusion"].tolist() == [0, 0, 0.25]
    assert table["contact"].tolist() == [pytest.approx(1 / 3), 0, 0.5]
    assert table["best_iou"].tolist() == [1, pytest.approx((1 + 1 + 0.5) / 3), 1]
    assert table["video_iou"].tolist() == [1, 0.5, 1]
    assert table["occurrences"].tolist() == [3, 3, 2]
    assert table["detected"].tolist() == [1, 1, 1]
    assert table["tracked"].tolist() == [1, pytest.approx(1 / 3), 1]
    assert table["switches"].tolist() == [0, 2, 0]
    assert table["j"].loc[1] == table["f"].loc[1] == 1


def test_without_metadata_or_objects(make) -> None:
    evaluator = Evaluator()
    evaluator.add("empty", make.strip([1, 2]), make.strip([0, 0]))
    assert evaluator.result()["per_object"].empty
    evaluator.add("some", make.strip([1, 2]), make.strip([0, 3]))
    table = evaluator.result()["per_object"]
    assert table["label"].tolist() == [3]
    assert table[["class", "occlusion", "contact"]].isna().all(axis=None)
    assert by_property(table)["property"].tolist() == ["size"]
    assert by_property(table.iloc[:0]).empty


def test_metadata_of_another_length_is_refused(make) -> None:
    with pytest.raises(ValueError, match=r"occlusion of the metadata has shape \(2, 3\); want .* \(3, 3\)"):
        Evaluator().add("a", make.strip([1], [1], [1]), make.strip([2], [2], [2]), metadata(2))


def test_means_by_property() -> None:
    objects = pd.DataFrame(dict.fromkeys(COLUMNS, 0.0), index=range(8)).astype({"class": object})
    objects["class"] = ["cup", "drill"] * 4
    objects["size"] = np.arange(8) / 8
    objects["best_iou"] = [0.0] * 4 + [1.0] * 4
    objects["contact"] = np.nan
    table = by_property(objects, bins=2)
    classes = table[table["property"] == "class"]
    assert classes["group"].tolist() == ["cup", "drill"]
    assert classes["objects"].tolist() == [4, 4]
    assert classes["best_iou"].tolist() == [0.5, 0.5]
    assert table[table["property"] == "size"]["best_iou"].tolist() == [0, 1]
    assert "contact" not in set(table["property"])
    assert table[table["property"] == "occlusion"]["objects"].tolist() == [8]
