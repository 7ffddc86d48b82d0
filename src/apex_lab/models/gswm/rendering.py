"""From objects to images and masks (gswm.md section 8)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from apex_lab.models.gswm.boxes import paste_window
from apex_lab.models.gswm.latents import Attributes
from apex_lab.models.gswm.networks import Decoder
from apex_lab.nn.precision import full
from apex_lab.nn.spatial_transformer import Paster
from apex_lab.nn.splitting import joined, part_size

IMPORTANCE_GUARD = 1e-5


class Drawn(NamedTuple):
    """N frames, or, as a video's, with (B, T) in place of N.

    masks (N, M, H, W): of the objects; what their sum leaves of 1 is the background's.
    reconstruction (N, 3, H, W): RGB in [0, 1].
    means (N, M, 3, H, W): the objects' own images before masking, where asked for.
    """

    masks: Tensor
    reconstruction: Tensor
    means: Tensor | None


class _Composition(torch.autograd.Function):
    """The sums of `compose`, with their gradient written by hand: plain autograd fills and passes many more tensors."""

    @staticmethod
    def forward(ctx: Any, pasted: Tensor, nearness: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        alpha = pasted[:, :, 3]
        share = alpha * nearness[..., None, None]
        total = share.sum(1, keepdim=True).add_(IMPORTANCE_GUARD)
        share.div_(total)
        ctx.save_for_backward(pasted, nearness, share, total)
        return (share[:, :, None] * pasted[:, :, :3]).sum(1), share * alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, on_image: Tensor, on_masks: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        pasted, nearness, share, total = ctx.saved_tensors
        colour, alpha = pasted[:, :, :3], pasted[:, :, 3]
        grad = torch.empty_like(pasted)
        torch.mul(share[:, :, None], on_image[:, None], out=grad[:, :, :3])
        on_share = (colour * on_image[:, None]).sum(2).addcmul_(on_masks, alpha)
        on_importance = on_share.sub_((share * on_share).sum(1, keepdim=True)).div_(total)
        torch.mul(on_masks, share, out=grad[:, :, 3])
        grad[:, :, 3].addcmul_(on_importance, nearness[..., None, None])
        return grad, (on_importance * alpha).sum((-2, -1))


def compose(
    pasted: Float[Tensor, "N M 4 H W"], nearness: Float[Tensor, "N M"]
) -> tuple[Float[Tensor, "N 3 H W"], Float[Tensor, "N M H W"]]:
    """Masked images and masks of objects, pasted, and sigmoid(-z_depth) -> the foreground and the objects' masks.

    Objects share a pixel by the importance A sigmoid(-z_depth). The images are masked already, so a mask enters once.
    """
    return _Composition.apply(pasted, nearness)


class Renderer(nn.Module):
    """Decodes objects, pastes them into the image and lays them over the background.

    Args:
        what: length of z_what.
        glimpse: side of the decoded glimpses in pixels.
        widths: channels of the decoder, from the coarsest level to the finest.
        image_size: H = W in pixels.
    """

    def __init__(self, what: int, glimpse: int, widths: Sequence[int], image_size: int) -> None:
        super().__init__()
        self.decoder = Decoder(what, glimpse, widths, 4, activation=True)
        self.glimpse, self.image_size = glimpse, image_size

    def forward(
        self,
        objects: Attributes,
        backdrop: Float[Tensor, "N 3 H W"],
        detail: bool = False,
        fixed_alpha: Float[Tensor, ""] | None = None,
    ) -> Drawn:
        """Objects (N, M, ...) of N frames and the background's images -> `Drawn`.

        Args:
            fixed_alpha: above 0, it takes the place of the decoded masks.
        """
        glimpses = full(self.decoder(objects.what.flatten(0, 1))).unflatten(0, objects.what.shape[:2])
        colour, alpha = glimpses.split([3, 1], dim=2)
        if fixed_alpha is not None:
            alpha = torch.where(fixed_alpha > 0, fixed_alpha, alpha)
        alpha = alpha * objects.pres[..., None, None]
        nearness, windows = torch.sigmoid(-objects.depth[..., 0]), paste_window(objects.where)
        masked = torch.cat([alpha * colour, alpha], dim=2)
        size = part_size(len(backdrop), masked.shape[1] * 4 * self.image_size**2, backdrop)
        parts = [x.split(size) for x in (masked, colour, nearness, windows, backdrop)]
        composed = [self._composed(a, c, n, w, b, detail) for a, c, n, w, b in zip(*parts, strict=True)]
        masks, reconstruction, means = zip(*composed, strict=True)
        return Drawn(joined(masks), joined(reconstruction), joined(means) if detail else None)

    def _composed(
        self, masked: Tensor, colour: Tensor, nearness: Tensor, windows: Tensor, backdrop: Tensor, detail: bool
    ) -> Drawn:
        paster = Paster(windows, self.glimpse, self.image_size)
        foreground, masks = compose(paster.each(masked), nearness)
        reconstruction = foreground + (1 - masks.sum(1, keepdim=True)) * backdrop
        return Drawn(masks, reconstruction, paster.each(colour) if detail else None)


def negative_log_likelihood(
    video: Float[Tensor, "B T 3 H W"], mean: Float[Tensor, "B T 3 H W"], sigma: Float[Tensor, ""]
) -> Float[Tensor, " B"]:
    """-log N(video; mean, sigma), summed over all pixels, channels and frames; nats."""
    values = video[0].numel()
    squares = (video - mean).square().flatten(1).sum(1)
    return 0.5 * squares / sigma.square() + values * (sigma.log() + 0.5 * math.log(2 * math.pi))
