"""A naive twin as the benchmark trains it: a model whose forward pass gives nothing but loss terms."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

from torch import Tensor, nn

from apex_lab.scene import Context, SceneModel


class Twin(SceneModel):
    """Wraps a twin so that `WeightUpdate` can train it.

    Args:
        model: whose terms, schedules and input size it has.
        weights: what is trained: the twin itself, or the model where the twin reads its weights.
        terms: (video, context) -> loss terms, each (B,).
        group: a parameter's name in the twin -> the beginning that its name has in the model, where the recipe has
            an optimiser for each such group.
    """

    def __init__(
        self,
        model: SceneModel,
        weights: nn.Module,
        terms: Callable[[Tensor, Context], dict[str, Tensor]],
        group: Callable[[str], str] = lambda name: "",
    ) -> None:
        super().__init__()
        self.weights = weights
        self.input_size = model.input_size
        self._terms, self._group = terms, group

    def forward(self, video: Tensor, context: Context) -> Any:
        """Not a `Scene`: its terms alone."""
        return SimpleNamespace(terms=self._terms(video, context), diagnostics={})

    def named_parameters(self, *args: Any, **options: Any) -> Iterator[tuple[str, nn.Parameter]]:
        """As of every module, with the beginnings by which the recipe tells its optimisers' parameters."""
        for name, weight in super().named_parameters(*args, **options):
            yield self._group(name.removeprefix("weights.")) + name, weight
