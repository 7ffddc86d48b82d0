"""Slot Attention written out a second time, straight from slot_attention.md and with plain autograd.

Frame by frame in a loop; keys and values of all tokens; layer norms, the GRU and the position code by hand; every slot
is copied to the whole grid before the decoder. Takes the weights of a model under their names.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from apex_lab.models.slot_attention import SlotAttention
from apex_lab.scene import Context
from tests.reference.adapter import Twin

Weights = Mapping[str, Tensor]

STRIDES = {
    "released": ((1, 1, 1, 1), (2, 2, 2, 2, 1)),
    "strided": ((1, 2, 2, 1), (2, 2, 2, 2, 1)),
    "small": ((1, 1, 1, 1), (1, 1, 1)),
}
"""Of encoder and decoder."""


def layer_norm(x: Tensor, weights: Weights, name: str) -> Tensor:
    centred = x - x.mean(-1, keepdim=True)
    scale = (centred.pow(2).mean(-1, keepdim=True) + 1e-3).sqrt()
    return centred / scale * weights[f"{name}.weight"] + weights[f"{name}.bias"]


def linear(x: Tensor, weights: Weights, name: str) -> Tensor:
    return x @ weights[f"{name}.weight"].T + weights.get(f"{name}.bias", torch.zeros((), dtype=x.dtype))


def perceptron(x: Tensor, weights: Weights, name: str) -> Tensor:
    return linear(linear(x, weights, f"{name}.0").relu(), weights, f"{name}.2")


def positions(height: int, width: int, dtype: torch.dtype) -> Tensor:
    axes = (torch.linspace(0, 1, n, dtype=dtype) for n in (height, width))
    row, column = torch.meshgrid(*axes, indexing="ij")
    return torch.stack([row, column, 1 - row, 1 - column], dim=-1)


def encode(image: Tensor, weights: Weights, strides: Sequence[int]) -> Tensor:
    """(3, H, W) in [-1, 1] -> tokens (L, C)."""
    x = image[None]
    for i, stride in enumerate(strides):
        name = f"encoder.convs.{i}"
        x = F.conv2d(x, weights[f"{name}.weight"], weights[f"{name}.bias"], stride, 2).relu()
    x = x[0].permute(1, 2, 0)
    x = x + linear(positions(*x.shape[:2], x.dtype), weights, "encoder.position.linear")
    return perceptron(layer_norm(x.flatten(0, 1), weights, "encoder.norm"), weights, "encoder.mlp")


def gru(x: Tensor, h: Tensor, weights: Weights) -> Tensor:
    r_x, z_x, n_x = (x @ weights["grouping.gru.weight_ih"].T + weights["grouping.gru.bias_ih"]).chunk(3, -1)
    r_h, z_h, n_h = (h @ weights["grouping.gru.weight_hh"].T + weights["grouping.gru.bias_hh"]).chunk(3, -1)
    r, z = torch.sigmoid(r_x + r_h), torch.sigmoid(z_x + z_h)
    return (1 - z) * torch.tanh(n_x + r * n_h) + z * h


def group(tokens: Tensor, noise: Tensor, weights: Weights, iterations: int) -> Tensor:
    """Tokens (L, C) and noise (K, D) -> slots (K, D)."""
    slots = weights["grouping.mu"] + weights["grouping.log_sigma"].exp() * noise
    x = layer_norm(tokens, weights, "grouping.norm_tokens")
    k, v = linear(x, weights, "grouping.to_k"), linear(x, weights, "grouping.to_v")
    for _ in range(iterations):
        q = linear(layer_norm(slots, weights, "grouping.norm_slots"), weights, "grouping.to_q")
        attention = torch.softmax(k @ q.T / slots.shape[-1] ** 0.5, dim=1) + 1e-8  # (L, K)
        attention = attention / attention.sum(0)
        slots = gru(attention.T @ v, slots, weights)
        slots = slots + perceptron(layer_norm(slots, weights, "grouping.norm_mlp"), weights, "grouping.mlp")
    return slots


def decode(slots: Tensor, weights: Weights, strides: Sequence[int], size: int) -> Tensor:
    """Slots (K, D) -> colours and mask logits (K, 4, H, W)."""
    for stride in strides:
        size //= stride
    position = linear(positions(size, size, slots.dtype), weights, "decoder.position.linear").permute(2, 0, 1)
    x = slots[:, :, None, None].repeat(1, 1, size, size) + position
    for i, stride in enumerate(strides):
        name = f"decoder.convs.{i - 1}" if i else "decoder.first"
        x = F.conv_transpose2d(
            x, weights[f"{name}.weight"], weights[f"{name}.bias"], stride, padding=2, output_padding=stride - 1
        ).relu()
    return F.conv_transpose2d(x, weights["decoder.head.weight"], weights["decoder.head.bias"], 1, 1)


def explain(
    video: Tensor, noise: Tensor, weights: Weights, variant: str = "released", iterations: int = 3
) -> tuple[Tensor, Tensor, Tensor]:
    """Video (B, T, 3, H, W) in [0, 1] and noise (B, T, K, D) -> masks (B, T, K, H, W), slots, loss (B,)."""
    encoder, decoder = STRIDES[variant]
    masks, slots, losses = [], [], []
    for frames, eps in zip(video, noise, strict=True):
        loss = torch.zeros((), dtype=video.dtype)
        for frame, start in zip(frames, eps, strict=True):
            image = frame * 2 - 1
            found = group(encode(image, weights, encoder), start, weights, iterations)
            drawn = decode(found, weights, decoder, frame.shape[-1])
            mask = torch.softmax(drawn[:, 3], dim=0)
            loss = loss + ((mask[:, None] * drawn[:, :3]).sum(0) - image).pow(2).mean()
            masks.append(mask)
            slots.append(found)
        losses.append(loss)
    shape = video.shape[:2]
    return torch.stack(masks).unflatten(0, shape), torch.stack(slots).unflatten(0, shape), torch.stack(losses)


def twins(model: SlotAttention, node: Mapping[str, Any]) -> dict[str, Twin]:
    """The twin that the benchmark trains, with the weights of `model`, which `node` has built."""

    def terms(video: Tensor, context: Context) -> dict[str, Tensor]:
        b, t = video.shape[:2]
        weights = dict(model.named_parameters())
        noise = context.noise.normal(video.new_empty(b, t, model.slots, len(weights["grouping.mu"])))
        _, _, loss = explain(video, noise, weights, node.get("variant", "released"), model.iterations)
        return {"mse": loss}

    return {"straightforward": Twin(model, model, terms)}
