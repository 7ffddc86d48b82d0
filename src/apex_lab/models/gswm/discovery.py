"""Discovery: new objects in the cells of a grid (gswm.md section 5)."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from apex_lab.models.gswm.boxes import discovered_box, gaussian_weight, rejected
from apex_lab.models.gswm.latents import DEPTH, WHERE, Attributes, gaussian, relaxed_bernoulli
from apex_lab.models.gswm.networks import cell_head
from apex_lab.nn.blocks import mlp
from apex_lab.nn.distributions import Gaussian
from apex_lab.nn.grid import cell_centres
from apex_lab.nn.precision import full

Draw = Literal["independent", "balanced", "batch"]


class Posterior(NamedTuple):
    """Raw outputs of discovery's heads and the sampled presence for a frame's cells; with (B, T) in front of a video's.

    prob (B, D), pres (B, D): posterior and sample of z_pres, the sample before rejection.
    rest (B, D, 2 (depth + where + what)), dyna (B, D, 2 dyna): means and raw standard deviations.
    """

    prob: Tensor
    pres: Tensor
    rest: Tensor
    dyna: Tensor


class Beliefs(NamedTuple):
    """Posteriors of the Gaussian latents of all cells."""

    depth: Gaussian
    where: Gaussian
    what: Gaussian
    dyna: Gaussian


def beliefs(rest: Float[Tensor, "... R"], dyna: Float[Tensor, "... two_dyna"], what: int) -> Beliefs:
    """The heads' outputs -> posteriors. Each latent's means stand before its raw standard deviations."""
    depth, where, appearance = rest.split([2 * DEPTH, 2 * WHERE, 2 * what], dim=-1)
    return Beliefs(gaussian(depth), gaussian(where), gaussian(appearance), gaussian(dyna))


class Discovery(nn.Module):
    """Features of the cells and what is tracked already -> candidates for new objects.

    Args:
        features: of a cell.
        grid: G.
        what, dyna: lengths of z_what and z_dyna.
        hidden: of the networks.
        map_sigma: standard deviation of the kernel by which tracked objects appear in the propagation map.
        rejection_iou: a cell's object whose box overlaps a tracked one by more is rejected; None rejects none.
    """

    centres: Tensor

    def __init__(
        self, features: int, grid: int, what: int, dyna: int, hidden: int, map_sigma: float, rejection_iou: float | None
    ) -> None:
        super().__init__()
        self.grid, self.what, self.hidden, self.map_sigma = grid, what, hidden, map_sigma
        self.rejection_iou = rejection_iou
        self.register_buffer("centres", cell_centres(grid), persistent=False)
        self.map_net = mlp([1 + DEPTH + WHERE + what + dyna, hidden, hidden, hidden])
        self.attribute_head = cell_head(features + hidden, hidden, 1 + 2 * (DEPTH + WHERE + what))
        self.dyna_head = cell_head(features + hidden, hidden, 2 * dyna)

    def propagation_map(self, tracked: Attributes) -> Float[Tensor, "B hidden G G"]:
        """Tracked objects on the grid, so that they are not discovered again. The kernel is not normalised."""
        features = self.map_net(tracked.joined()) * tracked.pres
        offset = tracked.where[:, :, None, 2:] - self.centres
        weight = gaussian_weight(offset, self.map_sigma).to(features.dtype)
        return (features.transpose(1, 2) @ weight).unflatten(-1, (self.grid, self.grid))

    def forward(
        self,
        features: Float[Tensor, "B F G G"],
        tracked: Attributes | None,
        noise: Float[Tensor, "B D N"],
        uniform: Float[Tensor, "B D"],
        temperature: Float[Tensor, ""],
    ) -> tuple[Attributes, Posterior]:
        """Samples of all cells, after rejection, and their posterior; `tracked` is None in a video's first frame."""
        if tracked is None:
            tracked_map = features.new_zeros(len(features), self.hidden, self.grid, self.grid)
        else:
            tracked_map = self.propagation_map(tracked)
        seen = torch.cat([features, tracked_map], dim=1)
        raw = self.attribute_head(seen).flatten(2).transpose(1, 2)
        raw_dyna = self.dyna_head(seen).flatten(2).transpose(1, 2)
        prob = torch.sigmoid(full(raw[..., 0]))
        pres = relaxed_bernoulli(prob, temperature, uniform)
        posterior = Posterior(prob, pres, raw[..., 1:], raw_dyna)

        found = beliefs(posterior.rest, posterior.dyna, self.what)
        drawn = noise.split([q.mean.shape[-1] for q in found], dim=-1)
        depth, where, what, dyna = (q.mean + q.std * e for q, e in zip(found, drawn, strict=True))
        where = discovered_box(where, self.centres)
        if tracked is not None and self.rejection_iou is not None:
            pres = pres * (1 - rejected(where, tracked.where, tracked.pres[..., 0], self.rejection_iou))
        return Attributes(pres[..., None], depth, where, what, dyna), posterior


class Discovering(NamedTuple):
    """Which frames discover.

    mask (B, T): the video discovers in the frame; None: all do.
    frames (B, N): the frames whose features are needed; None: all are.
    """

    mask: Bool[Tensor, "B T"] | None
    frames: Int[Tensor, "B N"] | None


def needed_frames(which: Discovering) -> Int[Tensor, "B N"] | None:
    """The frames whose features are needed; None: all are.

    As published, a frame in which no video of the batch discovers is not encoded, nor does batch normalisation see it.
    A GPU would have to wait for that number, and a CUDA graph or a compiler takes one shape only, so there all are.
    """
    if which.frames is not None or which.mask is None:
        return which.frames
    if which.mask.device.type != "cpu" or torch.compiler.is_compiling():
        return None
    needed = which.mask.any(0)
    needed[0] = True  # an encoder of no image would have no gradient
    return None if bool(needed.all()) else needed.nonzero().T.expand(len(which.mask), -1)


def discovering(uniform: Float[Tensor, "B T 2"], dropout: float, how: Draw, first: bool) -> Discovering:
    """Draws the frames of training in which discovery runs. A video's first frame always discovers.

    `independent`: every later frame discovers with probability 1 - dropout, and every video draws for itself, so that
    its result depends on no other. `batch`: one draw per frame for the whole batch, that of its first video, as
    published. `balanced`: every video for itself, but the number of such frames is the expected one (rounded down or
    up, at random), so that no more images have to be encoded than may discover.

    Args:
        uniform: in [0, 1).
        dropout: probability that a later frame does not discover.
        how: see above.
        first: the clip starts with the video's first frame.
    """
    b = len(uniform)
    later = uniform[:, int(first) :, 0]
    always = torch.ones(b, int(first), dtype=torch.bool, device=uniform.device)
    if how == "batch":
        later = later[:1].expand(b, -1)
    if how != "balanced" or later.shape[1] == 0:
        return Discovering(torch.cat([always, later >= dropout], dim=1), None)
    expected = later.shape[1] * (1 - dropout)
    sure, most = math.floor(expected + 1e-9), math.ceil(expected - 1e-9)
    order = later.argsort(dim=1)
    rank = order.argsort(dim=1)
    one_more = uniform[:, :1, 1] < expected - sure
    mask = torch.cat([always, (rank < sure) | ((rank == sure) & one_more)], dim=1)
    frames = torch.cat([torch.zeros_like(always, dtype=torch.long), order[:, :most] + int(first)], dim=1)
    return Discovering(mask, frames.sort(dim=1).values)
