"""Taking objects out of slots, against plain indexing."""

from __future__ import annotations

import torch

from apex_lab.nn.slots import gather_slots, leading, padded


def test_gather_slots_along_other_dimensions() -> None:
    source = torch.tensor([[2, 0], [1, 1]])
    values = torch.rand(2, 3, 4, 5)
    got = gather_slots(values, source)
    assert got.shape == (2, 2, 4, 5)
    assert torch.equal(got[0, 0], values[0, 2])
    assert torch.equal(got[1, 1], values[1, 1])
    chains = torch.rand(6, 2, 3, 4)
    assert torch.equal(gather_slots(chains, source, dim=2)[5, 0, 1], chains[5, 0, 0])
    video, frames = torch.rand(2, 3, 4, 5), torch.tensor([[[3], [0], [1]], [[2], [2], [0]]])
    got = gather_slots(video, frames, dim=2)
    assert got.shape == (2, 3, 1, 5)
    assert torch.equal(got[1, 1, 0], video[1, 1, 2])


def test_leading_slots_hold_all_that_is_valid() -> None:
    valid = torch.tensor([[True, False, False, False], [True, True, True, False]])
    assert leading(valid) == 3
    assert leading(torch.zeros(2, 4, dtype=torch.bool)) == 1
    assert leading(valid.to("meta")) == 4, "shapes depend on no data but on a CPU"
    values = torch.rand(2, 3, 5)
    whole = padded(values, 4)
    assert torch.equal(whole[:, :3], values)
    assert float(whole[:, 3:].abs().sum()) == 0
    assert padded(values, 3) is values
