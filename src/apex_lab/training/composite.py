"""Several optimisers as one: each over a group of the model's parameters, chosen by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from torch import nn
from torch.optim import Optimizer

NamedParameters = Iterable[tuple[str, nn.Parameter]]


class Composite(Optimizer):
    """One optimiser per named group of parameters; one `step` updates all.

    `param_groups` are those of the members, so learning rates are set and scheduled as for any optimiser. Clipping is
    not its business: the recipe clips one joint norm before.

    Args:
        params: names and parameters of the whole model.
        groups: group name -> `parameters`, the prefix of the parameters' names (or a list of prefixes), and
            `optimizer`, which makes the member from its parameters. Every parameter belongs to exactly one group.

    Raises:
        ValueError: a parameter belongs to no group or to several, or a group holds none.
    """

    def __init__(self, params: NamedParameters, groups: dict[str, dict[str, Any]]) -> None:
        named = list(params)
        self.members: dict[str, Optimizer] = {}
        for name, chosen in _chosen(named, groups).items():
            make: Callable[..., Optimizer] = groups[name]["optimizer"]
            self.members[name] = make(params=chosen)
        super().__init__([group for member in self.members.values() for group in member.param_groups], {})
        # the base class copies groups; members and whole must share them
        self.param_groups = [group for member in self.members.values() for group in member.param_groups]

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # type: ignore[override]
        """One update of every member; `closure`, where there is one, computes loss and gradients first."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for member in self.members.values():
            member.step()
        return loss

    def state_dict(self) -> dict[str, Any]:  # type: ignore[override]
        """The members' states by group name."""
        return {name: member.state_dict() for name, member in self.members.items()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:  # type: ignore[override]
        """The members' states by group name.

        Raises:
            ValueError: it holds other groups.
        """
        if state_dict.keys() != self.members.keys():
            raise ValueError(f"the state has the groups {sorted(state_dict)}, the optimiser {sorted(self.members)}")
        for name, member in self.members.items():
            member.load_state_dict(state_dict[name])
        self.param_groups = [group for member in self.members.values() for group in member.param_groups]


def _chosen(
    named: list[tuple[str, nn.Parameter]], groups: Mapping[str, Mapping[str, Any]]
) -> dict[str, list[tuple[str, nn.Parameter]]]:
    chosen: dict[str, list[tuple[str, nn.Parameter]]] = {name: [] for name in groups}
    for key, parameter in named:
        owners = [name for name, group in groups.items() if key.startswith(_prefixes(group))]
        if len(owners) != 1:
            found = f"several groups ({', '.join(owners)})" if owners else f"none of the groups {', '.join(groups)}"
            raise ValueError(f"the parameter {key} belongs to {found}: give prefixes that name each parameter once")
        chosen[owners[0]].append((key, parameter))
    for name, members in chosen.items():
        if not members:
            raise ValueError(f"the group {name} holds no parameter: its prefix fits no name of the model's parameters")
    return chosen


def _prefixes(group: Mapping[str, Any]) -> tuple[str, ...]:
    wanted = group["parameters"]
    return (wanted,) if isinstance(wanted, str) else tuple(wanted)
