"""Image likelihoods: APEX's spatial Gaussian mixture (Eq. 1) and the single Gaussian of the `gaussian` ablation."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from apex_lab.nn.activations import exp_
from apex_lab.nn.slots import may_look

Sigma = Annotated[float, Field(gt=0, le=10)]


def log_normal(x: Tensor, mean: Tensor, sigma: float | Tensor) -> Tensor:
    """log N(x; mean, sigma^2), elementwise; nats."""
    log_sigma = sigma.log() if isinstance(sigma, Tensor) else math.log(sigma)
    return -0.5 * ((x - mean) / sigma).square() - log_sigma - 0.5 * math.log(2 * math.pi)


NEGLIGIBLE = -80.0
"""Log of a share that no float32 sum of shares can tell from zero."""


def _exp_(x: Tensor) -> Tensor:
    """exp in place; below `NEGLIGIBLE` exactly zero, where CPUs take ten times as long for numbers that underflow."""
    return torch.threshold_(exp_(x.clamp_min_(NEGLIGIBLE)), 1.001 * math.exp(NEGLIGIBLE), 0.0)


class _LogMixture(torch.autograd.Function):
    """log sum_k exp(log_m_k + log N(x; mu_k, sigma_k)) per pixel and channel or per pixel, with its gradient by hand.

    This is the largest computation of a training step: plain autograd keeps some ten tensors of the size of all
    components' images, this keeps the responsibilities alone.
    """

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        image: Tensor,
        log_objects: Tensor,
        objects: Tensor,
        log_background: Tensor,
        background: Tensor,
        sigma_fg: Tensor,
        sigma_bg: Tensor,
        whole: bool,
    ) -> Tensor:
        """Shapes as in `Likelihood.__call__`, sigmas 0-dim -> log density in nats.

        (N, 3, H, W), or, where whole colours are mixed, (N, 1, H, W).
        """
        precision_fg: float | Tensor = 1 / sigma_fg**2
        channels = image.shape[1] if whole else 1
        by_object = image[:, None] - objects
        prior = (log_objects - channels * sigma_fg.log())[:, :, None]
        if whole:
            by_object = by_object.square_().sum(2, keepdim=True).mul_(-0.5 * precision_fg).add_(prior)
        elif may_look(image):  # with a number in place of a tensor, one pass in place of three
            precision_fg = float(precision_fg)
            torch.addcmul(prior, by_object, by_object, value=-0.5 * precision_fg, out=by_object)
        else:
            by_object = by_object.square_().mul_(-0.5 * precision_fg).add_(prior)
        by_background = (image[:, None] - background).square_()
        if whole:
            by_background = by_background.sum(2, keepdim=True)
        by_background.mul_(-0.5 / sigma_bg**2)
        by_background += (log_background - channels * sigma_bg.log() - math.log(background.shape[1]))[:, None, None]
        highest = torch.maximum(by_object.amax(1), by_background.amax(1))
        shares = _exp_(by_object.sub_(highest[:, None]))
        share_background = _exp_(by_background.sub_(highest[:, None]))
        total = shares.sum(1) + share_background.sum(1)
        shares /= total[:, None]
        share_background /= total[:, None]
        ctx.save_for_backward(shares, share_background, image, objects, background)
        ctx.precision = (precision_fg, 1 / sigma_bg**2)
        return total.log_().add_(highest).sub_(0.5 * channels * math.log(2 * math.pi))

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        shares, share_background, image, objects, background = ctx.saved_tensors
        precision_fg, precision_bg = ctx.precision
        by_object, by_background = shares * grad[:, None], share_background * grad[:, None]
        to_log_objects, to_log_background = by_object.sum(2), by_background.sum((1, 2))
        if by_object.shape[2] != image.shape[1]:  # one share for all channels
            by_object, by_background = by_object.expand_as(objects).clone(), by_background.expand_as(background).clone()
        if isinstance(precision_fg, float):
            to_objects = by_object.mul_(torch.sub(precision_fg * image[:, None], objects, alpha=precision_fg))
        else:
            to_objects = by_object.mul_(image[:, None] - objects).mul_(precision_fg)
        to_background = by_background.mul_(image[:, None] - background).mul_(precision_bg)
        to_image = -(to_objects.sum(1) + to_background.sum(1)) if ctx.needs_input_grad[0] else None
        return to_image, to_log_objects, to_objects, to_log_background, to_background, None, None, None


def _mean_density(logs: Float[Tensor, "N S ..."]) -> Float[Tensor, "N ..."]:
    """Log of the mean of S densities that are given by their logs."""
    return logs.squeeze(1) if logs.shape[1] == 1 else logs.logsumexp(1) - math.log(logs.shape[1])


def _scaled(sigma: Tensor, scale: Tensor | None) -> Tensor:
    return sigma if scale is None else sigma * scale.detach()


class Likelihood(ABC):
    """log p(x | masks, means), summed over pixels and channels."""

    @abstractmethod
    def __call__(
        self,
        image: Float[Tensor, "N 3 H W"],
        log_objects: Float[Tensor, "N K H W"],
        objects: Float[Tensor, "N K 3 H W"],
        log_background: Float[Tensor, "N H W"],
        background: Float[Tensor, "N S 3 H W"],
        scale_fg: Float[Tensor, ""] | None = None,
        scale_bg: Float[Tensor, ""] | None = None,
        whole: Float[Tensor, ""] | None = None,
    ) -> Float[Tensor, " N"]:
        """Log-likelihood of each image in nats.

        Args:
            image: RGB in [0, 1].
            log_objects: log masks of the objects; -inf where a mask is zero.
            objects: their means, RGB in [0, 1].
            log_background: log mask of the background; finite.
            background: its means: S images, each pixel as likely like one as like the other; the paper has one.
            scale_fg, scale_bg: factors of sigma_fg and sigma_bg; None leaves them. No gradient goes there.
            whole: in [0, 1], how much a mixture of whole colours counts beside one of channels; None: as it was built.
        """


class MixtureLikelihood(Likelihood):
    """Spatial Gaussian mixture with a standard deviation for the objects and one for the background (Eq. 1).

    Args:
        sigma_fg, sigma_bg: standard deviations in units of RGB in [0, 1]; the paper's values are 0.1 and 0.04.
        mixture_over: `channel` mixes each colour channel by itself (the GENESIS family), `pixel` mixes whole colours.
    """

    def __init__(
        self, sigma_fg: Sigma = 0.1, sigma_bg: Sigma = 0.04, mixture_over: Literal["channel", "pixel"] = "channel"
    ) -> None:
        self.sigma_fg, self.sigma_bg, self.mixture_over = sigma_fg, sigma_bg, mixture_over

    def _sigmas(self, like: Tensor, scale_fg: Tensor | None, scale_bg: Tensor | None) -> tuple[Tensor, Tensor]:
        fg, bg = like.new_full((), self.sigma_fg), like.new_full((), self.sigma_bg)
        return _scaled(fg, scale_fg), _scaled(bg, scale_bg)

    def __call__(
        self,
        image: Float[Tensor, "N 3 H W"],
        log_objects: Float[Tensor, "N K H W"],
        objects: Float[Tensor, "N K 3 H W"],
        log_background: Float[Tensor, "N H W"],
        background: Float[Tensor, "N S 3 H W"],
        scale_fg: Float[Tensor, ""] | None = None,
        scale_bg: Float[Tensor, ""] | None = None,
        whole: Float[Tensor, ""] | None = None,
    ) -> Float[Tensor, " N"]:
        sigma_fg, sigma_bg = self._sigmas(image, scale_fg, scale_bg)
        args = (image, log_objects, objects, log_background, background, sigma_fg, sigma_bg)
        return self._mixed(whole, lambda pixel: _LogMixture.apply(*args, pixel).flatten(1).sum(1))

    def _mixed(self, whole: Tensor | None, value: Callable[[bool], Tensor]) -> Tensor:
        """A value by whole colours (true), by channels (false), or some of both; on a CPU what counts alone."""
        if whole is None:
            return value(self.mixture_over == "pixel")
        if may_look(whole) and float(whole) in (0, 1):
            return value(bool(whole))
        by_channel, by_pixel = value(False), value(True)
        return torch.lerp(by_channel, by_pixel, whole.to(by_channel.dtype))

    def responsibilities(
        self,
        image: Float[Tensor, "N 3 H W"],
        masks: Float[Tensor, "N K H W"],
        means: Float[Tensor, "N K 3 H W"],
        background: Bool[Tensor, " K"],
        scale_fg: Float[Tensor, ""] | None = None,
        scale_bg: Float[Tensor, ""] | None = None,
        shadowed: Float[Tensor, "N K 3 H W"] | None = None,
        whole: Float[Tensor, ""] | None = None,
    ) -> Float[Tensor, "N K H W"]:
        """p(component | pixel), the posterior under Eq. 1: m_k N(x; mu_k, sigma_k^2) over its sum over components.

        Where channels are mixed each by itself, a pixel has one posterior per channel: their mean is returned.

        Args:
            image: RGB in [0, 1].
            masks: of all components, sum to 1 over K.
            means: their images, RGB in [0, 1].
            background: which components have the background's standard deviation.
            scale_fg, scale_bg, whole: as in `__call__`.
            shadowed: a second image of each component, in shadow, say; at each pixel as likely as `means`; None: none.
        """
        sigma_fg, sigma_bg = self._sigmas(image, scale_fg, scale_bg)
        sigma = torch.where(background, sigma_bg, sigma_fg)[:, None, None, None]
        images = torch.stack([means] if shadowed is None else [means, shadowed], dim=1)
        each = log_normal(image[:, None, None], images, sigma)
        log_masks = masks.log()[:, :, None]

        def by(pixel: bool) -> Tensor:
            if pixel:
                return (log_masks + _mean_density(each.sum(3, keepdim=True))).softmax(1).squeeze(2)
            return (log_masks + _mean_density(each)).softmax(1).mean(2)

        return self._mixed(whole, by)


class GaussianLikelihood(Likelihood):
    """One Gaussian around the blended image, N(x; sum_k m_k mu_k, sigma^2): the `gaussian` ablation.

    Args:
        sigma: standard deviation in units of RGB in [0, 1]; the paper names none, default sigma_fg. So it is what
            `scale_fg` multiplies; there is no sigma_bg. It blends the last of the background's images.
    """

    def __init__(self, sigma: Sigma = 0.1) -> None:
        self.sigma = sigma

    def __call__(
        self,
        image: Float[Tensor, "N 3 H W"],
        log_objects: Float[Tensor, "N K H W"],
        objects: Float[Tensor, "N K 3 H W"],
        log_background: Float[Tensor, "N H W"],
        background: Float[Tensor, "N S 3 H W"],
        scale_fg: Float[Tensor, ""] | None = None,
        scale_bg: Float[Tensor, ""] | None = None,
        whole: Float[Tensor, ""] | None = None,
    ) -> Float[Tensor, " N"]:
        blend = (log_objects.exp()[:, :, None] * objects).sum(1) + log_background.exp()[:, None] * background[:, -1]
        sigma = _scaled(image.new_full((), self.sigma), scale_fg)
        return log_normal(image, blend, sigma).flatten(1).sum(1)
