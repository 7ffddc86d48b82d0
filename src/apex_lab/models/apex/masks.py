"""Mask normalisation: APEX's (Eq. 7-12) and SCALOR's, which the `scalor_norm` ablation swaps in.

Both answer the same three questions from glimpses of mask logits. Pixels are (H, W) = (size, size); an invalid
component (a slot that holds nothing) adds exactly zero to the foreground and exactly -inf to the competition.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Annotated, Any, Literal, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from apex_lab.nn.activations import exp, tanh
from apex_lab.nn.precision import full
from apex_lab.nn.slots import may_look
from apex_lab.nn.spatial_transformer import Paster

TINY = 1e-30
"""A mask below it is zero: its logarithm is -inf, and no gradient comes from it."""


NEARLY = 1 - 1e-6
"""The largest share of a bound whose inverse is taken."""


class Masks(NamedTuple):
    """Masks of one set of components and of the background; logs are for the likelihood, shares for everything else.

    objects: (..., K, H, W); foreground, background: (..., H, W). objects.sum(-3) + background = 1.
    log_objects: -inf for invalid components and wherever a mask is below `TINY`; log_background: finite.
    """

    objects: Tensor
    log_objects: Tensor
    foreground: Tensor
    background: Tensor
    log_background: Tensor


@torch.no_grad()
def blended(
    objects: Float[Tensor, "N K H W"],
    means: Float[Tensor, "N K C H W"],
    background: Float[Tensor, "N H W"],
    backdrop: Float[Tensor, "N C H W"],
) -> Float[Tensor, "N C H W"]:
    """The reconstruction, sum_k m_k mu_k, for the eye: without gradient."""
    image = background[:, None] * backdrop
    if not may_look(image):
        return (objects[:, :, None] * means).sum(1) + image
    for k in range(objects.shape[1]):  # without a tensor of all components' shares
        image.addcmul_(objects[:, k, None], means[:, k])
    return image


class MaskNormalisation(ABC):
    """How mask logits of overlapping windows become masks that sum to one."""

    @abstractmethod
    def logits(self, raw: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
        """Decoder output -> alpha, the glimpse that all other methods take."""

    @abstractmethod
    def raw(self, alpha: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
        """The decoder output that gives this alpha; bounded where alpha is as large as it can be."""

    @abstractmethod
    def foreground(
        self, alpha: Float[Tensor, "... K g g"], presence: Float[Tensor, "... K"], paster: Paster
    ) -> Float[Tensor, "... H W"]:
        """m_fg of these components alone, in [0, 1]; absent ones have a presence of exactly zero."""

    @abstractmethod
    def claim(self, alpha: Float[Tensor, "... K g g"], paster: Paster) -> Float[Tensor, "... K H W"]:
        """What each component would cover on its own, in [0, 1], zero outside its window (p_context)."""

    @abstractmethod
    def compose(
        self,
        alpha: Float[Tensor, "... K g g"],
        presence: Float[Tensor, "... K"],
        valid: Bool[Tensor, "... K"],
        paster: Paster,
    ) -> Masks:
        """All masks of a frame."""


class _Claim(torch.autograd.Function):
    """tanh(softplus(x)) times rows and columns, with its gradient written by hand.

    A step does this for every cell of every frame at full resolution: plain autograd keeps five tensors of that size,
    this keeps the cover and its result, which p_context keeps anyway.
    """

    @staticmethod
    def forward(ctx: Any, warped: Tensor, rows: Tensor, columns: Tensor) -> Tensor:  # type: ignore[override]
        # tanh(softplus(x)) = n / (n + 2) with n = e^x (e^x + 2): one exponential, no logarithm
        power = exp(warped)
        cover = power.add(2).mul_(power)
        cover.div_(torch.add(cover, 2, out=power))
        claims = (cover * rows[..., :, None]).mul_(columns[..., None, :])
        ctx.save_for_backward(cover, claims, rows, columns)
        return claims

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # type: ignore[override]
        cover, claims, rows, columns = ctx.saved_tensors
        to_inside = grad * cover
        to_rows = (to_inside @ columns[..., :, None]).squeeze(-1)
        to_columns = (rows[..., None, :] @ to_inside).squeeze(-2)
        # With c = tanh(softplus(x)): dc/dx = (1 - c^2) sigmoid(x), and sigmoid(x) = 2 c / (1 + c + sqrt(1 - c^2)).
        rest = cover.square().neg_().add_(1)
        below = torch.sqrt(rest, out=to_inside).add_(cover).add_(1)
        return rest.mul_(claims).mul_(grad).div_(below).mul_(2), to_rows, to_columns


class _Compete(torch.autograd.Function):
    """Softmax over components times the foreground, and its logarithm (Eq. 10 and 11), with a gradient by hand.

    Plain autograd passes over tensors of the size of all components' masks some thirty times, this half as often.
    """

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, warped: Tensor, shift: Tensor, foreground: Tensor, log_foreground: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Logits (..., K, H, W), what is added to them (..., K), -inf for components that hold nothing, m_fg and log.

        Returns m_k and log m_k (..., K, H, W).
        """
        # Where nothing is valid the softmax has no finite entry; any finite stand-in will do, since m_fg is zero there.
        nothing = shift.isneginf().all(-1)[..., None, None]
        logit = full(warped) + shift[..., None, None]
        # A common shift changes no share, but logits of 3 c would cost the float32 sum of the masks its sixth decimal.
        logit -= logit.amax(-3).masked_fill_(nothing, 0.0)[..., None, :, :]
        share = exp(logit)
        total = share.sum(-3).masked_fill_(nothing, 1.0)
        share /= total[..., None, :, :]  # Eq. 10
        logit += (log_foreground - total.log_())[..., None, :, :]
        ctx.save_for_backward(share, foreground)
        return share * foreground[..., None, :, :], logit  # Eq. 11

    @staticmethod
    def backward(ctx: Any, grad: Tensor, grad_log: Tensor) -> tuple[Tensor, ...]:  # type: ignore[override]
        share, foreground = ctx.saved_tensors
        to_logit = grad * share
        to_foreground, to_log_foreground = to_logit.sum(-3), grad_log.sum(-3)
        common = torch.addcmul(to_log_foreground, foreground, to_foreground)
        to_logit.mul_(foreground[..., None, :, :])
        to_logit.addcmul_(share, common[..., None, :, :], value=-1).add_(grad_log)
        return to_logit, to_logit.sum((-2, -1)), to_foreground, to_log_foreground


class ApexNormalisation(MaskNormalisation):
    """APEX's mask normalisation, in log space throughout (Eq. 7-12).

    Args:
        c: bounds the mask logits to [-c, c] (Eq. 7); up to 40, since float32 holds no e^(2 c) beyond.
        outside: what a present component's logit counts outside its window: `zero` is the literal reading of Eq. 9 (the
            warp pads with zeros), `minus_c` pads with the weakest logit.
    """

    def __init__(
        self, c: Annotated[float, Field(gt=0, le=40)] = 5.0, outside: Literal["zero", "minus_c"] = "zero"
    ) -> None:
        self.c, self.outside = c, outside

    def logits(self, raw: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
        """alpha = c tanh(CNN(z_what)) (Eq. 7)."""
        return self.c * tanh(raw)

    def raw(self, alpha: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
        """The inverse of `logits`, within +-7.25."""
        return torch.atanh((full(alpha) / self.c).clamp(-NEARLY, NEARLY))

    def _occupancy(
        self, alpha: Float[Tensor, "... K g g"], presence: Float[Tensor, "... K"], paster: Paster
    ) -> Float[Tensor, "... H W"]:
        """s = sum_k STN(softplus(alpha_k) z_pres_k), the argument of the tanh in Eq. 8."""
        return paster.total(F.softplus(alpha) * presence[..., None, None])

    def foreground(
        self, alpha: Float[Tensor, "... K g g"], presence: Float[Tensor, "... K"], paster: Paster
    ) -> Float[Tensor, "... H W"]:
        """m_fg = tanh(s) (Eq. 8)."""
        return tanh(self._occupancy(alpha, presence, paster))

    def claim(self, alpha: Float[Tensor, "... K g g"], paster: Paster) -> Float[Tensor, "... K H W"]:
        """tanh(softplus(alpha)) of the warped logits, inside the window only (the weights of p_context, Eq. 18)."""
        rows, columns = paster.inside()
        warped = paster.each(alpha[..., None, :, :]).squeeze(-3)
        return _Claim.apply(warped, rows, columns)

    def _competition(
        self,
        alpha: Float[Tensor, "... K g g"],
        presence: Float[Tensor, "... K"],
        valid: Bool[Tensor, "... K"],
        paster: Paster,
    ) -> tuple[Float[Tensor, "... K H W"], Float[Tensor, "... K"]]:
        """alpha_hat = STN(alpha) + 2 c z_pres (Eq. 9), as these two; -inf for components that hold nothing."""
        base = 0.0 if self.outside == "zero" else -self.c
        warped = paster.each((alpha - base if base else alpha)[..., None, :, :]).squeeze(-3)
        return warped, (2 * self.c * presence + base).masked_fill(~valid, -torch.inf)

    def compose(
        self,
        alpha: Float[Tensor, "... K g g"],
        presence: Float[Tensor, "... K"],
        valid: Bool[Tensor, "... K"],
        paster: Paster,
    ) -> Masks:
        """Softmax over the foreground (Eq. 10), times m_fg (Eq. 11); the background is the rest (Eq. 12)."""
        s = self._occupancy(alpha, torch.where(valid, presence, torch.zeros_like(presence)), paster)
        foreground = torch.tanh(s)  # Eq. 8
        # Exactly nothing where no window reaches: a floor there would let a component's empty surroundings, which are
        # black, explain dark pixels that the background misses.
        log_foreground = foreground.clamp_min(TINY).log().masked_fill(s < TINY, -torch.inf)
        objects, log_objects = _Compete.apply(
            *self._competition(alpha, presence, valid, paster), foreground, log_foreground
        )
        return Masks(
            objects=objects,
            log_objects=log_objects,
            foreground=foreground,
            background=2 * torch.sigmoid(-2 * s),  # Eq. 12: 1 - tanh(s), without cancellation
            log_background=F.logsigmoid(-2 * s) + math.log(2),
        )


class ScalorNormalisation(MaskNormalisation):
    """SCALOR's mask normalisation, for the ablations (apex_paper, "Ablation Study").

    Masks alpha^s in [0, 1] are warped, weighted by presence and normalised as alpha_k^2 / sum_k alpha_k; the foreground
    is clamped to [0, 1] and the background is the rest.
    """

    def logits(self, raw: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
        """alpha^s = sigmoid(CNN(z_what))."""
        return torch.sigmoid(raw)

    def raw(self, alpha: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
        """The inverse of `logits`, within +-13.8."""
        return torch.logit(full(alpha), eps=1 - NEARLY)

    def _warped(
        self, alpha: Float[Tensor, "... K g g"], presence: Float[Tensor, "... K"], paster: Paster
    ) -> Float[Tensor, "... K H W"]:
        return paster.each((alpha * presence[..., None, None])[..., None, :, :]).squeeze(-3)

    @staticmethod
    def _normalised(warped: Float[Tensor, "... K H W"]) -> tuple[Tensor, Tensor]:
        objects = warped.square() / warped.sum(-3, keepdim=True).clamp_min(1e-6)
        return objects, objects.sum(-3).clamp(0, 1)

    def foreground(
        self, alpha: Float[Tensor, "... K g g"], presence: Float[Tensor, "... K"], paster: Paster
    ) -> Float[Tensor, "... H W"]:
        """The clamped sum of the normalised masks."""
        return self._normalised(self._warped(alpha, presence, paster))[1]

    def claim(self, alpha: Float[Tensor, "... K g g"], paster: Paster) -> Float[Tensor, "... K H W"]:
        """The warped mask itself."""
        return paster.each(alpha[..., None, :, :]).squeeze(-3)

    def compose(
        self,
        alpha: Float[Tensor, "... K g g"],
        presence: Float[Tensor, "... K"],
        valid: Bool[Tensor, "... K"],
        paster: Paster,
    ) -> Masks:
        """alpha^2 / sum(alpha); absent components have a presence of zero, hence a mask of zero."""
        present = torch.where(valid, presence, torch.zeros_like(presence))
        objects, foreground = self._normalised(self._warped(alpha, present, paster))
        background = 1 - foreground
        log_objects = objects.clamp_min(TINY).log().masked_fill(objects < TINY, -torch.inf)
        return Masks(objects, log_objects, foreground, background, background.clamp_min(1e-6).log())
