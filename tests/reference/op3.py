"""OP3 as one would write it down first (op3.md): oracle of the model's tests, baseline of its benchmark.

It takes a model's weights and shares none of its code. The slot is tiled over the image and convolved, all gradients
come from autograd through a graph that is kept for a second differentiation, as in the published code, and every step
is written out frame by frame.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from apex_lab.models.op3 import Op3
from apex_lab.scene import Noise
from tests.reference.adapter import Twin


@dataclass
class Explained:
    """What the twin finds: terms (B,), masks (B, T, K, H, W), and the total loss of the page, divided by B."""

    terms: dict[str, Tensor]
    masks: Tensor
    total: Tensor


class NaiveOp3:
    """A second implementation with the weights of `model`."""

    def __init__(self, model: Op3) -> None:
        self.model = model
        self.k = model.slots

    def __call__(self, video: Tensor, noise: Noise) -> Explained:
        with torch.enable_grad():
            return self._infer(video, noise)

    def _infer(self, video: Tensor, noise: Noise) -> Explained:
        model = self.model
        b, t = video.shape[:2]
        k, s = self.k, len(model.start_mean)
        deterministic = model.start_deterministic.expand(b, k, -1)
        lam1, lam2 = model.start_mean.expand(b, k, -1), model.start_raw.expand(b, k, -1)
        prior1 = torch.zeros(b, k, s, device=video.device)
        prior2 = torch.full((b, k, s), math.log(math.e - 1), device=video.device)
        h = c = torch.zeros(b * k, model.refinement.lstm.hidden_size, device=video.device)
        masks, weighted, weights = [], [], []

        def step_loss(image, z):
            colours, logits = self.decode(torch.cat([deterministic, z], -1))
            mask = logits.softmax(1)
            error = ((colours - image[:, None]) ** 2).sum(2)
            density = torch.exp(-error / (2 * 3 * model.sigma**2)) / (model.sigma**3 * 248.05)
            total = (mask * density).sum(1)
            nll = -torch.log(total + 1e-12).sum((1, 2))
            v, pv = deviation(lam2) ** 2, deviation(prior2) ** 2
            divergence = (0.5 * (torch.log(pv / v) + (v + (lam1 - prior1) ** 2) / pv - 1)).sum((1, 2))
            return colours, logits, mask, density, total, nll, divergence

        for frame in range(t):
            image, draw = video[:, frame], noise.at(frame)
            if frame > 0:
                deterministic, lam1, lam2 = self.predict(torch.cat([deterministic, z], -1))  # noqa: F821
                prior1, prior2 = lam1, lam2
                h = c = torch.zeros_like(h)
            n = model.plan.first if frame == 0 else model.plan.later
            z = lam1 + deviation(lam2) * draw.normal(lam1)
            found = step_loss(image, z)
            if frame > 0:
                weighted.append(found[5:])
                weights.append(1.0)
            for j in range(n):
                colours, logits, mask, density, total, nll, divergence = found
                loss = (nll + model.beta * divergence).sum() / (model.loss_batch or b)
                gradients = torch.autograd.grad(
                    loss, [mask, colours, lam1, lam2], create_graph=torch.is_grad_enabled(), retain_graph=True
                )
                d_mask, d_colours, d_lam1, d_lam2 = (g.detach() for g in gradients)
                size = video.shape[-1]
                grid = torch.linspace(-1, 1, size, device=video.device)
                everywhere = (b, k, size, size)
                maps = torch.cat(
                    [
                        image[:, None].expand(b, k, 3, size, size),
                        colours,
                        mask[:, :, None],
                        logits[:, :, None],
                        (density / (density.sum(1, keepdim=True) + 1e-8))[:, :, None],
                        norm(d_mask[:, :, None], model.refinement.norm_masks, 1e-5, 3),
                        norm(
                            total[:, None, None].expand(b, k, 1, size, size).detach(),
                            model.refinement.norm_density,
                            1e-5,
                            3,
                        ),
                        norm(
                            (total[:, None] - mask * density)[:, :, None].detach(),
                            model.refinement.norm_others,
                            1e-5,
                            3,
                        ),
                        norm(d_colours, model.refinement.norm_colours, 1e-5, 3),
                        grid.expand(everywhere)[:, :, None],
                        grid[:, None].expand(everywhere)[:, :, None],
                    ],
                    dim=2,
                )
                vector = torch.cat(
                    [
                        norm(d_lam1, model.refinement.norm_mean, 1e-6, 1),
                        norm(d_lam2, model.refinement.norm_raw, 1e-6, 1),
                        lam1,
                        lam2,
                        z,
                    ],
                    dim=-1,
                )
                lam1, lam2, h, c = self.refine(maps, vector, h, c)
                z = lam1 + deviation(lam2) * draw.normal(lam1)
                found = step_loss(image, z)
                weighted.append(found[5:])
                weights.append((j + 1) / n)
            masks.append(found[2])
        if model.plan.weighting == "linear":
            weights = list(range(1, len(weights) + 1))
        terms = {
            name: sum(w * value[i] for w, value in zip(weights, weighted, strict=True)) / sum(weights)
            for i, name in enumerate(("nll", "kl"))
        }
        total = sum(
            w * (nll.sum() / b + model.beta * divergence.sum() / b)
            for w, (nll, divergence) in zip(weights, weighted, strict=True)
        ) / sum(weights)
        return Explained(terms, torch.stack(masks, 1), total)

    def decode(self, slot: Tensor) -> tuple[Tensor, Tensor]:
        """(B, K, Z) -> colours (B, K, 3, H, W), mask logits (B, K, H, W)."""
        decoder = self.model.decoder
        b, k, z = slot.shape
        size = self.model.input_size[0]
        grid = torch.linspace(-1, 1, size, device=slot.device)
        x = torch.cat(
            [
                slot.reshape(b * k, z, 1, 1).expand(-1, -1, size, size),
                grid.expand(b * k, 1, size, size),
                grid[:, None].expand(b * k, 1, size, size),
            ],
            dim=1,
        )
        convs = [decoder.first, *decoder.others]
        for i, conv in enumerate(convs):
            x = F.conv2d(x, conv.weight, conv.bias, padding=2)
            x = F.elu(x) if i < len(convs) - 1 else x
        x = x.reshape(b, k, 4, size, size)
        return x[:, :, :3], x[:, :, 3]

    def refine(self, maps: Tensor, vector: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Image input (B, K, 17, H, W), vector input (B, K, 5 S), LSTM state -> lam1, lam2 (B, K, S), LSTM state."""
        net = self.model.refinement
        b, k = maps.shape[:2]
        x = maps.flatten(0, 1)
        for conv in net.convs:
            x = F.elu(F.conv2d(x, conv.weight, conv.bias, padding=2))
        x = F.avg_pool2d(x, x.shape[-1]).flatten(1)
        x = torch.cat([F.elu(F.linear(x, net.compress.weight, net.compress.bias)), vector.flatten(0, 1)], 1)
        cell = net.lstm
        gates = F.linear(x, cell.weight_ih, cell.bias_ih) + F.linear(h, cell.weight_hh, cell.bias_hh)
        i, f, g, o = gates.chunk(4, 1)
        c = f.sigmoid() * c + i.sigmoid() * g.tanh()
        h = o.sigmoid() * c.tanh()
        heads = (F.linear(h, head.weight, head.bias).reshape(b, k, -1) for head in (net.to_mean, net.to_raw))
        return (*heads, h, c)

    def predict(self, slot: Tensor) -> list[Tensor]:
        """(B, K, Z) -> d, lam1, lam2 of the next frame, pair by pair."""
        net = self.model.dynamics

        def run(mlp, x, activation=lambda y: y):
            return activation(F.linear(F.elu(F.linear(x, mlp[0].weight, mlp[0].bias)), mlp[2].weight, mlp[2].bias))

        e = run(net.inertia, slot, F.elu)
        merged = []
        for i in range(self.k):
            effect = torch.zeros(len(slot), 32, device=slot.device)
            for j in range(self.k):
                if i != j:
                    u = run(net.pair, torch.cat([e[:, i], e[:, j]], -1), F.elu)
                    effect = effect + run(net.attention, u, torch.sigmoid) * run(net.effect, u, F.elu)
            merged.append(run(net.merge, torch.cat([e[:, i], effect], -1), F.elu))
        g = torch.stack(merged, 1)
        return [run(head, g) for head in (net.to_deterministic, net.to_mean, net.to_raw)]


def deviation(raw: Tensor) -> Tensor:
    """Raw scale -> standard deviation."""
    return torch.sqrt(torch.log(1 + torch.exp(raw.clamp(max=80))) + 1e-5)


def norm(x: Tensor, weights: torch.nn.Module, epsilon: float, dims: int) -> Tensor:
    """Layer norm over the last `dims` dimensions, with the scale and shift of `weights`."""
    axes = tuple(range(-dims, 0))
    scale, shift = (p.reshape(-1, *[1] * (dims - 1)) for p in (weights.scale, weights.shift))
    return (x - x.mean(axes, keepdim=True)) / (x.std(axes, keepdim=True) + epsilon) * scale + shift


def twins(model: Op3, node: Mapping[str, Any]) -> dict[str, Twin]:
    """The twin that the benchmark trains, with the weights of `model`, which `node` has built."""
    naive = NaiveOp3(model)
    return {"straightforward": Twin(model, model, lambda video, context: naive(video, context.noise).terms)}
