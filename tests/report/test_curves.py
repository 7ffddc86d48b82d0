"""Curves of many seeds: reading, thinning, mean and spread."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from apex_lab.report.curves import POINTS, read_curves, spread, thinned


def test_what_is_no_finite_number_is_no_point(tmp_path: Path) -> None:
    file = tmp_path / "curves.csv"
    file.write_text("step,train/loss,val/ari\n1,2.5,\n2,nan,0.5\n3,inf,0.25\n4,x,\nfive,1,1\n6,-1e3,0.")
    found = read_curves(file, ["train/loss", "val/ari", "val/msc"])
    assert found == {"train/loss": [(1, 2.5), (6, -1000)], "val/ari": [(2, 0.5), (3, 0.25), (6, 0)]}


def test_a_row_cut_off_by_a_kill_is_left_out(tmp_path: Path) -> None:
    file = tmp_path / "curves.csv"
    file.write_text("step,train/loss,val/ari\n1,2.5,0.5\n2,3")
    assert read_curves(file, ["train/loss"]) == {"train/loss": [(1, 2.5)]}


def test_a_step_that_was_done_again_counts_once_and_in_its_place(tmp_path: Path) -> None:
    file = tmp_path / "curves.csv"
    file.write_text("step,train/loss\n1,1\n2,2\n3,3\n2,20\n")
    assert read_curves(file, ["train/loss"]) == {"train/loss": [(1, 1), (2, 20), (3, 3)]}


@pytest.mark.parametrize("content", [b"", b"a,b\n1,2\n", b"\xff\xfe\x00", b"step,train/loss\n"])
def test_a_damaged_table_has_no_curves(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "curves.csv").write_bytes(content)
    assert read_curves(tmp_path / "curves.csv", ["train/loss"]) == {}
    assert read_curves(tmp_path / "none.csv", ["train/loss"]) == {}


def test_mean_and_deviation_are_over_the_finished_seeds_at_their_common_steps() -> None:
    steps = [10.0, 20.0, 30.0]
    values = np.random.default_rng(0).normal(size=(3, 3))
    seeds = {seed: list(zip(steps, row.tolist(), strict=True)) for seed, row in enumerate(values)}
    seeds[1] = seeds[1][:2]  # resumed elsewhere: its last value is not there
    seeds[7] = [(10.0, 1e6)]  # failed
    found = spread(seeds, finished={0, 1, 2})
    assert [step for step, _ in found.mean] == [10, 20]
    np.testing.assert_allclose([value for _, value in found.mean], values.mean(0)[:2])
    assert found.deviation is not None
    np.testing.assert_allclose(found.deviation, values.std(0, ddof=1)[:2])
    assert found.averaged == 3
    assert set(found.seeds) == {0, 1, 2, 7}


def test_one_seed_has_no_deviation_and_unfinished_ones_no_mean() -> None:
    assert spread({0: [(1.0, 2.0)]}, {0}).deviation is None
    found = spread({0: [(1.0, 2.0)], 1: [(1.0, 3.0)]}, set())
    assert found.mean == []
    assert found.averaged == 0


def test_long_curves_become_means_of_stretches() -> None:
    points = [(float(step), float(step)) for step in range(1, 1001)]
    found = thinned(points, 1000.0)
    assert len(found) == POINTS
    assert found[0] == (5.0, 5.0)  # steps 1 to 9 lie in the first of 100 stretches of 10
    assert found[50] == (505.0, pytest.approx(504.5))  # steps 500 to 509
    assert found[-1] == (995.0, pytest.approx(995.0))  # steps 990 to 1000


def test_seeds_are_thinned_in_the_same_stretches() -> None:
    long = [(float(step), 1.0) for step in range(1, 401)]
    found = spread({0: long, 1: long[:200]}, {0, 1})
    assert found.thinned
    assert [step for step, _ in found.seeds[1]] == [step for step, _ in found.seeds[0]][:51]
