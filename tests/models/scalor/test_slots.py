"""Which objects are carried on, in which slot and under which id."""

from __future__ import annotations

import pytest
import torch

from apex_lab.models.scalor.slots import Objects, admitted, carry, keep, pack, strongest

YES, NO = True, False


@pytest.mark.parametrize(
    ("count", "want"),
    [
        (0, [NO, NO, NO, NO]),
        (1, [NO, YES, NO, NO]),
        (2, [NO, YES, NO, NO]),  # 0.5 ties with the third: neither is taken
        (3, [YES, YES, YES, NO]),
        (4, [YES, YES, YES, YES]),
        (9, [YES, YES, YES, YES]),
    ],
)
def test_cap_is_strict(count: int, want: list[bool]) -> None:
    presence = torch.tensor([[0.5, 0.9, 0.5, 0.1]])
    assert strongest(presence, torch.tensor([count]))[0].tolist() == want


def test_pack() -> None:
    chosen = torch.tensor([[NO, YES, NO, YES, YES], [NO, NO, NO, NO, NO]])
    source, valid = pack(chosen, 2)
    assert source[0].tolist() == [1, 3]
    assert valid.tolist() == [[YES, YES], [NO, NO]]


def test_ids_are_never_used_again() -> None:
    """Three slots, two cells: the objects 1 and 2 are there, 2 ends, two arrive; then all end and one arrives."""
    ids = torch.tensor([[1, 2, -1]])
    kept = keep(torch.tensor([[YES, NO, NO]]), torch.tensor([[YES, YES]]), ids, torch.tensor([3]))
    assert kept.ids.tolist() == [[1, 3, 4]]
    assert kept.source.tolist() == [[0, 3, 4]]
    assert kept.next_id.tolist() == [5]
    kept = keep(torch.tensor([[NO, NO, NO]]), torch.tensor([[NO, YES]]), kept.ids, kept.next_id)
    assert kept.ids.tolist() == [[5, -1, -1]]
    assert kept.valid.tolist() == [[YES, NO, NO]]


def test_arrivals_without_a_slot_are_dropped() -> None:
    kept = keep(torch.tensor([[YES, YES]]), torch.tensor([[YES, YES]]), torch.tensor([[1, 2]]), torch.tensor([3]))
    assert kept.ids.tolist() == [[1, 2]]
    assert kept.source.tolist() == [[0, 1]]


@pytest.mark.parametrize(
    ("free", "want"),
    [
        (0, [NO, NO, NO, NO, NO]),
        (1, [NO, NO, YES, NO, NO]),
        (2, [YES, NO, YES, NO, NO]),  # the first of two equally strong ones
        (3, [YES, NO, YES, YES, NO]),
        (9, [YES, NO, YES, YES, YES]),
    ],
)
def test_the_strongest_arrivals_find_a_slot(free: int, want: list[bool]) -> None:
    """0.95 does not arrive (it may be rejected); one of 0.71 stands behind stronger ones."""
    arrives, presence = torch.tensor([[YES, NO, YES, YES, YES]]), torch.tensor([[0.8, 0.95, 0.9, 0.8, 0.71]])
    assert admitted(arrives, presence, torch.tensor([free]))[0].tolist() == want


def test_the_strongest_arrivals_are_packed_row_by_row() -> None:
    """Two of four slots are free, three cells arrive, the first of them is the weakest."""
    stays, arrives = torch.tensor([[YES, NO, YES, NO]]), torch.tensor([[YES, YES, NO, YES]])
    arrives = admitted(arrives, torch.tensor([[0.71, 0.8, 0.1, 0.9]]), torch.tensor([2]))
    kept = keep(stays, arrives, torch.tensor([[1, 2, 3, -1]]), torch.tensor([4]))
    assert kept.source.tolist() == [[0, 2, 5, 7]]
    assert kept.ids.tolist() == [[1, 3, 4, 5]]
    assert kept.next_id.tolist() == [6]


def objects(count: int, offset: float) -> Objects:
    base = offset + torch.arange(count, dtype=torch.float32)[None, :, None]
    return Objects(*(base.expand(1, count, width).clone().requires_grad_() for width in (3, 4, 4, 1, 1, 5, 2, 2, 1)))


@pytest.mark.parametrize("flow", [0.0, 1.0])
def test_carry_and_the_stop_of_gradients(flow: float) -> None:
    old, new = objects(2, 1.0), objects(2, 10.0)
    kept = keep(torch.tensor([[NO, YES]]), torch.tensor([[NO, YES]]), torch.tensor([[1, 2]]), torch.tensor([3]))
    carried = carry((old, new), kept, torch.tensor(flow))
    assert [x[0, :, 0].tolist() for x in carried] == [[2.0, 11.0]] * len(carried)
    carried.what.sum().backward()
    assert old.what.grad is not None
    assert old.what.grad[0, :, 0].tolist() == [0.0, flow]


def test_empty_slots_hold_zeros() -> None:
    old, new = objects(2, 1.0), objects(2, 10.0)
    kept = keep(torch.tensor([[NO, NO]]), torch.tensor([[YES, NO]]), torch.tensor([[1, 2]]), torch.tensor([3]))
    carried = carry((old, new), kept, torch.tensor(1.0))
    assert [x[0, :, 0].tolist() for x in carried] == [[10.0, 0.0]] * len(carried)


def test_new_objects_start_without_a_past() -> None:
    one = torch.ones(1, 2, 1)
    found = Objects.found(torch.ones(1, 2, 3), torch.ones(1, 2, 4), one, one, 5, 6)
    for name in ("raw", "tracker", "prior_h", "prior_c", "absence"):
        assert float(getattr(found, name).abs().sum()) == 0
    assert found.raw.shape[-1] == 4
    assert found.tracker.shape[-1] == 5
    assert found.prior_c.shape[-1] == 6
