"""Filtering and identities, against a plain Python list of objects."""

import torch

from apex_lab.models.apex.slots import carry, gather_slots


def test_identities_are_never_reused_and_survivors_keep_slot_and_id() -> None:
    g = torch.Generator().manual_seed(0)
    b, p, n = 4, 3, 5
    ids = torch.full((b, p), -1)
    valid = torch.zeros(b, p, dtype=torch.bool)
    next_id = torch.ones(b, dtype=torch.long)
    given: list[set[int]] = [set() for _ in range(b)]
    alive: list[dict[int, int]] = [{} for _ in range(b)]
    for _ in range(60):
        presence = torch.rand(b, p + n, generator=g)
        exists = torch.cat([valid, torch.rand(b, n, generator=g) < 0.4], 1)
        out = carry(presence, exists, ids, next_id, 0.5)
        for i in range(b):
            ranked = sorted(
                (j for j in range(p + n) if exists[i, j] and presence[i, j] >= 0.5), key=lambda j: -presence[i, j]
            )
            chosen = set(ranked[:p])
            held = {int(out.source[i, s]) for s in range(p) if out.valid[i, s]}
            assert held == chosen
            for s in range(p):
                identity = int(out.ids[i, s])
                assert (identity == -1) == (not out.valid[i, s])
                if not out.valid[i, s]:
                    continue
                if int(out.source[i, s]) < p:  # it was here before: same slot, same identity
                    assert int(out.source[i, s]) == s
                    assert alive[i][s] == identity
                else:
                    assert identity not in given[i]
                    given[i].add(identity)
            alive[i] = {s: int(out.ids[i, s]) for s in range(p) if out.valid[i, s]}
            newcomers = [int(out.ids[i, s]) for s in range(p) if out.valid[i, s] and int(out.source[i, s]) >= p]
            strength = [float(presence[i, out.source[i, s]]) for s in range(p)]
            by_id = sorted(newcomers)
            order = [strength[[int(x) for x in out.ids[i]].index(k)] for k in by_id]
            assert order == sorted(order, reverse=True)  # the strongest newcomer gets the lowest id
        ids, valid, next_id = out.ids, out.valid, out.next_id
    assert all(given[i] == set(range(1, int(next_id[i]))) for i in range(b))
    assert min(len(x) for x in given) > 10


def test_threshold_is_inclusive_and_empty_input_stays_empty() -> None:
    ids = torch.tensor([[1, 2]])
    out = carry(torch.tensor([[0.5, 0.499, 0.1]]), torch.ones(1, 3, dtype=torch.bool), ids, torch.tensor([3]), 0.5)
    assert out.ids.tolist() == [[1, -1]]
    none = carry(torch.zeros(1, 3), torch.zeros(1, 3, dtype=torch.bool), ids, torch.tensor([3]), 0.5)
    assert none.ids.tolist() == [[-1, -1]]
    assert none.next_id.tolist() == [3]


def test_a_stronger_discovery_replaces_the_weakest_object_under_a_new_id() -> None:
    presence = torch.tensor([[0.9, 0.6, 0.95]])
    out = carry(presence, torch.ones(1, 3, dtype=torch.bool), torch.tensor([[4, 7]]), torch.tensor([8]), 0.5)
    assert out.ids.tolist() == [[4, 8]]
    assert out.source.tolist() == [[0, 2]]


def test_gather_slots() -> None:
    values = torch.arange(24).reshape(2, 3, 4)
    got = gather_slots(values, torch.tensor([[2, 0], [1, 1]]))
    assert got.tolist() == [[values[0, 2].tolist(), values[0, 0].tolist()], [values[1, 1].tolist()] * 2]
