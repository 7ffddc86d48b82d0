"""A step captured as a CUDA graph, by the rules of PyTorch's documentation ("CUDA Graphs").

The work is done a few times on a side stream first, so that the optimiser's state is there, kernels are chosen and
compiled, and no node of autograd belongs to the default stream. What is captured reads its input where it was read in
capture, has memory of its own, and allocates its gradients there, so they must be None when it begins. PyTorch notes
which random numbers the captured work draws, and tells the graph at each replay which seed and offset its generator
has: a replay after `torch.manual_seed` draws what the same work would draw without capture.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from apex_lab.base.errors import UserError
from apex_lab.base.validation import one_line

Work = Callable[[Tensor], dict[str, Tensor]]


class SideStream:
    """Where a step is warmed up and captured.

    Args:
        device: of the step; on a CPU there are no streams, and work goes on as it is.
    """

    def __init__(self, device: torch.device) -> None:
        self.stream = torch.cuda.Stream(device) if device.type == "cuda" else None

    @contextlib.contextmanager
    def ordered(self) -> Iterator[None]:
        """Work inside is done on this stream, after what was begun before it and before what comes after it."""
        if self.stream is None:
            yield
            return
        outside = torch.cuda.current_stream(self.stream.device)
        self.stream.wait_stream(outside)
        with torch.cuda.stream(self.stream):
            yield
        outside.wait_stream(self.stream)


class Captured:
    """One step for inputs of one shape.

    Args:
        work: input -> values; done once for capture, which changes no number.
        given: an input.
        side: where the work was warmed up.

    Raises:
        UserError: the work holds what a graph cannot.
    """

    def __init__(self, work: Work, given: Tensor, side: SideStream) -> None:
        self.shape = given.shape
        self._given = given.clone()
        self._graph = torch.cuda.CUDAGraph()
        # other threads may use the device meanwhile, such as the one that pins the memory of batches
        try:
            with torch.cuda.graph(self._graph, stream=side.stream, capture_error_mode="thread_local"):
                self._values = work(self._given)
        except torch.OutOfMemoryError:
            raise
        except RuntimeError as error:
            raise UserError(
                f"This step cannot be captured as a CUDA graph ({one_line(error)}): set trainer.cuda_graph=false."
            ) from error

    def __call__(self, given: Tensor) -> dict[str, Tensor]:
        """Does the work; its values stay until the next call."""
        self._given.copy_(given)
        self._graph.replay()
        return self._values
