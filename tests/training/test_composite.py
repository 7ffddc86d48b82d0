"""Several optimisers as one do what each would do by itself."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn

from apex_lab.config import components
from apex_lab.training.composite import Composite
from apex_lab.training.update import named_parameters, remember_rates

NODE = {
    "_target_": "apex_lab.training.composite.Composite",
    "groups": {
        "front": {"parameters": "0.", "optimizer": {"_target_": "torch.optim.RMSprop", "_partial_": True, "lr": 1e-2}},
        "back": {
            "parameters": ["1.", "2."],
            "optimizer": {"_target_": "torch.optim.Adam", "_partial_": True, "lr": 1e-3},
        },
    },
}


def network() -> nn.Sequential:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(3, 4), nn.Linear(4, 4), nn.Linear(4, 2))


def steps(model: nn.Module, *optimizers: torch.optim.Optimizer, count: int = 4) -> None:
    for i in range(count):
        torch.manual_seed(i)
        model.zero_grad()
        model(torch.randn(5, 3)).square().sum().backward()
        for optimizer in optimizers:
            optimizer.step()


def test_it_is_its_members_side_by_side() -> None:
    ours, theirs = network(), network()
    components.check(NODE, "optimizer", supplied=["params"])
    optimizer = components.build(NODE, "optimizer", params=named_parameters(ours))
    assert isinstance(optimizer, Composite)
    assert [group["lr"] for group in optimizer.param_groups] == [1e-2, 1e-3]
    steps(ours, optimizer)
    back = [*theirs[1].parameters(), *theirs[2].parameters()]
    steps(theirs, torch.optim.RMSprop(theirs[0].parameters(), lr=1e-2), torch.optim.Adam(back, lr=1e-3))
    for a, b in zip(ours.parameters(), theirs.parameters(), strict=True):
        assert torch.equal(a, b)


def test_a_learning_rate_set_on_its_groups_counts() -> None:
    model = network()
    before = copy.deepcopy(model.state_dict())
    optimizer = remember_rates(components.build(NODE, "optimizer", params=named_parameters(model)))
    for group in optimizer.param_groups:
        group["lr"] = 0.0 if group["initial_lr"] == 1e-2 else group["initial_lr"]
    steps(model, optimizer, count=1)
    assert torch.equal(model[0].weight, before["0.weight"])
    assert not torch.equal(model[1].weight, before["1.weight"])


def test_resuming_gives_the_unbroken_run() -> None:
    whole, broken = network(), network()
    steps(whole, components.build(NODE, "optimizer", params=named_parameters(whole)), count=2)
    first = components.build(NODE, "optimizer", params=named_parameters(broken))
    steps(broken, first, count=2)
    stored = copy.deepcopy(first.state_dict())
    optimizer = components.build(NODE, "optimizer", params=named_parameters(whole))
    optimizer.load_state_dict(stored)
    second = components.build(NODE, "optimizer", params=named_parameters(broken))
    second.load_state_dict(copy.deepcopy(stored))  # loading does not copy tensors
    steps(whole, optimizer)
    steps(broken, second)
    assert all(torch.equal(a, b) for a, b in zip(whole.parameters(), broken.parameters(), strict=True))
    with pytest.raises(ValueError, match="the state has the groups"):
        second.load_state_dict({"other": {}})


@pytest.mark.parametrize(
    ("prefixes", "words"),
    [
        (("0.", "1."), "2.weight belongs to none of the groups a, b"),
        (("", "1."), "1.weight belongs to several groups \\(a, b\\)"),
        (("", "nothing"), "the group b holds no parameter"),
    ],
)
def test_every_parameter_belongs_to_one_group(prefixes: tuple[str, str], words: str) -> None:
    groups = {
        name: {"parameters": prefix, "optimizer": lambda params: torch.optim.SGD(params, lr=1.0)}
        for name, prefix in zip("ab", prefixes, strict=True)
    }
    with pytest.raises(ValueError, match=words):
        Composite(named_parameters(network()), groups)
