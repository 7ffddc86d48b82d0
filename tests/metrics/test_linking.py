from __future__ import annotations

import numpy as np

from apex_lab.metrics import link_frames


def test_names_of_segments_are_linked_by_overlap(make) -> None:
    truth = make.strip([0, 0, 1, 2], [0, 0, 1, 2], [0, 1, 1, 2])
    names = np.array([[7, 3, 5], [50, 60, 70], [2, 1, 0]])
    found = names[np.arange(3)[:, None, None], truth]
    linked = link_frames(found)
    for label in range(3):
        assert len(np.unique(linked[truth == label])) == 1
    assert len(np.unique(linked)) == 3


def test_a_new_segment_gets_a_number_never_used_before(make) -> None:
    linked = link_frames(make.strip([4, 4, 6], [4, 4, 4], [4, 4, 6], [4, 8, 6]))
    assert linked[:, 0, ::8].tolist() == [[0, 0, 1], [0, 0, 0], [0, 0, 2], [0, 3, 2]]


def test_huge_names_and_bytes(make) -> None:
    found = make.strip([0, 1], [1, 0]).astype(np.uint8)
    assert link_frames(found).tolist() == link_frames(found.astype(np.int64) * 2**50).tolist()
