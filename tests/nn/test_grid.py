"""Cells of a grid, by number."""

from __future__ import annotations

import torch

from apex_lab.nn.grid import cell_centres, cells


def test_cells_are_counted_row_by_row() -> None:
    assert cells(2, torch.zeros(())).tolist() == [[0, 0], [1, 0], [0, 1], [1, 1]]  # (column, row)
    assert cell_centres(2).tolist() == [[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]]  # (x, y)
    assert torch.equal(cell_centres(8), 2 * (cells(8, torch.zeros(())) + 0.5) / 8 - 1)
