"""The background: K components with masks by stick breaking, in the manner of GENESIS (space.md section 5)."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from apex_lab.models.space.broadcast import BroadcastDecoder
from apex_lab.models.space.latents import split_gaussian
from apex_lab.models.space.likelihood import GUARD
from apex_lab.models.space.networks import StridedEncoder, mask_decoder, strong_decoder
from apex_lab.nn.distributions import Gaussian, kl_gaussian
from apex_lab.nn.precision import full
from apex_lab.scene import Noise

FLOOR = 1e-4
"""Smallest standard deviation of the background's latents."""


class Layers(NamedTuple):
    """The background of n images.

    masks (n, K, H, W): pi, sum to 1 over K; means (n, K, 3, H, W): RGB in [0, 1]; components (n, K, Z): z_c.
    """

    masks: Tensor
    means: Tensor
    components: Tensor


class Recurrent(nn.Module):
    """LSTM cell whose states give the Gaussian of the next mask latent.

    Args:
        inputs: length of what each step takes.
        hidden: length of the state.
        latent: length of z_m.
    """

    def __init__(self, inputs: int, hidden: int, latent: int) -> None:
        super().__init__()
        self.start_hidden = nn.Parameter(torch.zeros(hidden))
        self.start_cell = nn.Parameter(torch.zeros(hidden))
        self.cell = nn.LSTMCell(inputs, hidden)
        self.head = nn.Linear(hidden, 2 * latent)

    def start(self, batch: int) -> tuple[Float[Tensor, "n hidden"], Float[Tensor, "n hidden"]]:
        """The learned state before the first step."""
        return self.start_hidden.expand(batch, -1), self.start_cell.expand(batch, -1)

    def gaussian(self, hidden: Float[Tensor, "... hidden"]) -> Gaussian:
        """Distribution of z_m read from a hidden state."""
        return split_gaussian(self.head(hidden), FLOOR)


class Background(nn.Module):
    """Posterior, prior and decoder of the K components.

    Args:
        image_size: H = W in pixels, a power of two.
        components: K; a single one has no masks and a stronger decoder.
        mask, component: lengths of z_m and z_c.
        features: length of the image's code.
        hidden: of both LSTM cells and the component prior.
        width: channels of the broadcast decoder.
    """

    def __init__(
        self, image_size: int, components: int, mask: int, component: int, features: int, hidden: int, width: int
    ) -> None:
        super().__init__()
        self.image_size, self.components = image_size, components
        self.image_encoder = StridedEncoder(image_size, [3, 64, 64, 64, 64], features)
        self.start_mask = nn.Parameter(torch.zeros(mask))
        self.mask_posterior = Recurrent(mask + features, hidden, mask)
        self.mask_prior = Recurrent(mask, hidden, mask)
        self.mask_decoder = mask_decoder(mask, image_size)
        self.component_encoder = StridedEncoder(image_size, [4, 32, 32, 64, 64], 2 * component)
        self.component_prior = nn.Sequential(
            nn.Linear(mask, hidden),
            nn.ELU(),
            nn.Linear(hidden, hidden),
            nn.ELU(),
            nn.Linear(hidden, 2 * component),
        )
        if components == 1:
            self.component_decoder: nn.Module = strong_decoder(component, image_size)
        else:
            self.component_decoder = BroadcastDecoder(component, image_size, width)

    def forward(self, images: Float[Tensor, "n 3 H W"], noise: Noise) -> tuple[Layers, dict[str, Float[Tensor, " n"]]]:
        """RGB in [0, 1] -> the background's components and their KL terms."""
        z_mask, q_mask = self._infer_masks(full(F.elu(self.image_encoder(images))), noise)
        kl_mask = kl_gaussian(q_mask, self._mask_prior(z_mask))
        masks = self._masks(z_mask)
        log_masks = (masks + GUARD).log()[:, :, None]
        seen = torch.cat([log_masks, images[:, None].expand(-1, self.components, -1, -1, -1)], dim=2)
        code = self.component_encoder(seen.flatten(0, 1)).unflatten(0, (-1, self.components))
        q_component = split_gaussian(code, FLOOR)
        kl_component = kl_gaussian(q_component, split_gaussian(self.component_prior(z_mask), FLOOR))
        z_component = q_component.sample(noise)
        means = full(self.component_decoder(z_component.flatten(0, 1))).unflatten(0, (-1, self.components))
        return Layers(masks, means, z_component), {"kl_mask": kl_mask.sum(1), "kl_component": kl_component.sum(1)}

    def _infer_masks(
        self, code: Float[Tensor, "n features"], noise: Noise
    ) -> tuple[Float[Tensor, "n K mask"], Gaussian]:
        """Samples of z_m, each given those before it, and their posteriors (n, K, mask)."""
        hidden, cell = self.mask_posterior.start(len(code))
        z = self.start_mask.expand(len(code), -1)
        samples, posteriors = [], []
        for _ in range(self.components):
            with torch.autocast(code.device.type, enabled=False):
                hidden, cell = self.mask_posterior.cell(torch.cat([z, code], dim=1), (hidden, cell))
            posterior = self.mask_posterior.gaussian(hidden)
            z = posterior.sample(noise)
            samples.append(z)
            posteriors.append(posterior)
        return torch.stack(samples, dim=1), Gaussian(*(torch.stack(part, 1) for part in zip(*posteriors, strict=True)))

    def _mask_prior(self, z: Float[Tensor, "n K mask"]) -> Gaussian:
        """p(z_m,k | z_m,<k) at posterior samples; the first is read from the learned state before any update."""
        state = self.mask_prior.start(len(z))
        states = [state[0]]
        for k in range(self.components - 1):
            with torch.autocast(z.device.type, enabled=False):
                state = self.mask_prior.cell(z[:, k], state)
            states.append(state[0])
        return self.mask_prior.gaussian(torch.stack(states, dim=1))

    def _masks(self, z: Float[Tensor, "n K mask"]) -> Float[Tensor, "n K H W"]:
        """Masks pi; the last component's z_m is not decoded, since it takes what is left."""
        if self.components == 1:
            return z.new_ones(len(z), 1, self.image_size, self.image_size)
        taken = full(self.mask_decoder(z[:, :-1].flatten(0, 1)))
        return stick_breaking(taken.squeeze(1).unflatten(0, (len(z), -1)))


def stick_breaking(taken: Float[Tensor, "n K_1 H W"]) -> Float[Tensor, "n K H W"]:
    """Share in [0, 1] that each of the first K - 1 components takes of what is left -> K masks that sum to 1."""
    left = torch.ones_like(taken[:, 0])
    masks = []
    for share in taken.unbind(1):
        masks.append(share * left)
        left = left - masks[-1]
    return torch.stack([*masks, left], dim=1)
