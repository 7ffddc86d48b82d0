"""G-SWM as one would write it down first: oracle of the model's tests and baseline of its benchmark.

Written from gswm.md alone, frame by frame: every crop and paste is an `affine_grid` and a `grid_sample`; everything
happens inside the loop over time; pairs of objects are concatenated and read by whole perceptrons; both chains do all
their work by themselves; every discovered cell gets a recurrent state; gradients are autograd's. Frames in which no
video of the batch discovers skip discovery, as the published code does.

`Naive(model)` copies the weights of a model. Only slots and identities follow the model's rule (slots.py), since random
numbers belong to slots.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence

from apex_lab.models.gswm import Gswm
from apex_lab.scene import Context
from tests.reference.adapter import Twin


def perceptron(*sizes: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for i in range(len(sizes) - 1):
        layers.append(nn.Linear(sizes[i], sizes[i + 1]))
        if i < len(sizes) - 2:
            layers.append(nn.CELU())
    return nn.Sequential(*layers)


def copied(target: nn.Module, source: nn.Module) -> nn.Module:
    """Weights in the order in which they were made."""
    with torch.no_grad():
        pairs = list(zip(target.parameters(), source.parameters(), strict=True))
        for into, weight in pairs:
            assert into.shape == weight.shape, (into.shape, weight.shape)
            into.copy_(weight)
        for into, value in zip(target.buffers(), source.buffers(), strict=True):
            into.copy_(value)
    return target


def chain_perceptron(source: Any, chain: int) -> nn.Sequential:
    """One chain's perceptron (or linear layer) out of the model's pair."""
    layers = [source.first, source.second, source.last] if hasattr(source, "first") else [source]
    sizes = [layers[0].weight.shape[1], *(layer.weight.shape[2] for layer in layers)]
    net = perceptron(*sizes)
    with torch.no_grad():
        for linear, layer in zip([m for m in net if isinstance(m, nn.Linear)], layers, strict=True):
            linear.weight.copy_(layer.weight[chain].T)
            linear.bias.copy_(layer.bias[chain, 0])
    return net


class Block(nn.Module):
    """A block of ResNet-18."""

    def __init__(self, block: Any) -> None:
        super().__init__()
        a, b = block.conv_1, block.conv_2
        self.conv1 = nn.Conv2d(a.in_channels, a.out_channels, 3, a.stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(a.out_channels)
        self.conv2 = nn.Conv2d(b.in_channels, b.out_channels, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(b.out_channels)
        self.down = None
        if block.shortcut is not None:
            c = block.shortcut
            self.down = nn.Sequential(
                nn.Conv2d(c.in_channels, c.out_channels, 1, c.stride, bias=False), nn.BatchNorm2d(c.out_channels)
            )
        copied(self, block)

    def forward(self, x: Tensor) -> Tensor:
        y = self.bn2(self.conv2(F.relu(self.bn1(self.conv1(x)))))
        return F.relu(y + (x if self.down is None else self.down(x)))


def encoder(source: Any) -> nn.Sequential:
    """Strided convolutions, each with CELU and GroupNorm, and a linear layer (sections 2 and 3)."""
    layers: list[nn.Module] = []
    for layer in source.convs:
        if isinstance(layer, nn.Conv2d):
            layers.append(nn.Conv2d(layer.in_channels, layer.out_channels, layer.kernel_size, 2, layer.padding))
        elif isinstance(layer, nn.GroupNorm):
            layers += [nn.CELU(), nn.GroupNorm(layer.num_groups, layer.num_channels)]
    head = nn.Linear(source.head.in_features, source.head.out_features)
    return cast(nn.Sequential, copied(nn.Sequential(*layers, nn.Flatten(), head), source))


def decoder(source: Any, activation: bool) -> nn.Sequential:
    """A linear layer and sub-pixel convolutions, with CELU and GroupNorm between them and a sigmoid at the end."""
    convs = [layer for layer in source.convs if isinstance(layer, nn.Conv2d)]
    norms = [layer for layer in source.convs if isinstance(layer, nn.GroupNorm)]
    stem, first = source.stem, convs[0].in_channels
    side = math.isqrt(stem.out_features // first)
    layers: list[nn.Module] = [nn.Linear(stem.in_features, stem.out_features)]
    layers += [nn.CELU()] if activation else []
    layers.append(nn.Unflatten(1, (first, side, side)))
    for i, conv in enumerate(convs):
        layers += [nn.Conv2d(conv.in_channels, conv.out_channels, 3, padding=1), nn.PixelShuffle(2)]
        if i < len(norms):
            layers += [nn.CELU(), nn.GroupNorm(norms[i].num_groups, norms[i].num_channels)]
    return cast(nn.Sequential, copied(nn.Sequential(*layers, nn.Sigmoid()), source))


class Chain(nn.Module):
    """Interaction and LSTM of the posterior (chain 0) or the prior (chain 1)."""

    def __init__(self, history: Any, chain: int) -> None:
        super().__init__()
        nets = history.interaction
        self.self_net = chain_perceptron(nets.self_net, chain)
        self.pair_net = chain_perceptron(nets.pair_net, chain)
        self.logit_net = chain_perceptron(nets.logit_net, chain)
        self.linear = chain_perceptron(history.input, chain)[0]
        hidden = history.hidden
        self.cell = nn.LSTMCell(hidden, hidden)
        with torch.no_grad():
            self.cell.weight_ih.copy_(history.from_input.weight[chain].T)
            self.cell.bias_ih.copy_(history.from_input.bias[chain, 0])
            self.cell.weight_hh.copy_(history.from_hidden.weight[chain].T)
            self.cell.bias_hh.copy_(history.from_hidden.bias[chain, 0])
        self.start_h = nn.Parameter(history.start[0, chain].detach().clone())
        self.start_c = nn.Parameter(history.start[1, chain].detach().clone())

    def interaction(self, z: Tensor, h: Tensor) -> Tensor:
        phi = torch.cat([z, h], -1)
        b, n, d = phi.shape
        one = phi[:, :, None].expand(b, n, n, d)
        other = phi[:, None].expand(b, n, n, d)
        relative = z[:, :, None, 4:6] - z[:, None, :, 4:6]
        other = torch.cat([other[..., :4], relative, other[..., 6:]], -1)
        pair = torch.cat([one, other], -1)
        weight = self.logit_net(pair)[..., 0].softmax(-1) * z[:, None, :, 0]
        weight = weight * (1 - torch.eye(n))
        weight = weight / (weight.sum(-1, keepdim=True) + 1e-4)
        return self.self_net(phi) + (weight[..., None] * self.pair_net(pair)).sum(2)

    def forward(self, z: Tensor, around: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
        x = self.linear(torch.cat([z, self.interaction(z, h), around], -1))
        b, n, d = h.shape
        h, c = self.cell(x.reshape(b * n, -1), (h.reshape(b * n, d), c.reshape(b * n, d)))
        return h.view(b, n, d), c.view(b, n, d)


class Naive(nn.Module):
    """The twin of a model, with its weights."""

    def __init__(self, model: Gswm) -> None:
        super().__init__()
        self.settings = {
            "dropout": model.discovery_dropout,
            "how": model.discovery_draw,
            "scale_std": model.scale_std,
            "sigma_map": model.discovery.map_sigma,
            "iou": model.discovery.rejection_iou,
            "margin": model.history.margin,
        }
        self.grid, self.m, self.what = model.image_encoder.grid, model.max_objects, model.what
        self.size, self.g = model.image_size, model.renderer.glimpse
        self.motion, self.environment = model.propagation.motion, model.history.environment
        assert model.background is not None
        bg = model.background
        self.bg_encoder, self.bg_decoder = encoder(bg.encoder), decoder(bg.decoder, activation=False)
        self.bg_q, self.bg_p = copy.deepcopy(bg.q_net), copy.deepcopy(bg.p_net)
        self.bg_q_cell = copy.deepcopy(bg.q_cell)
        self.bg_p_cell = copied(nn.LSTMCell(bg.latent, bg.start.shape[1]), bg.p_lstm)
        self.bg_start = nn.Parameter(bg.start.detach().clone())
        images = model.image_encoder
        conv = nn.Conv2d(6, images.conv.out_channels, 7, 2, 3, bias=False)
        stages = [Block(block) for block in images.stages]
        self.resnet = nn.Sequential(
            copied(conv, images.conv),
            copied(nn.BatchNorm2d(images.conv.out_channels), images.norm),
            nn.ReLU(),
            *stages,
            copy.deepcopy(images.head),
        )
        discovery, propagation = model.discovery, model.propagation
        self.map_net = copy.deepcopy(discovery.map_net)
        self.attribute_head, self.dyna_head = (
            copy.deepcopy(discovery.attribute_head),
            copy.deepcopy(discovery.dyna_head),
        )
        self.grow, self.encoder = copy.deepcopy(propagation.grow_net), encoder(propagation.encoder)
        self.q_dyna, self.p_dyna = copy.deepcopy(propagation.q_net), copy.deepcopy(propagation.p_net)
        self.change = copy.deepcopy(propagation.change_net)
        self.decoder = decoder(model.renderer.decoder, activation=True)
        if self.environment != "none":
            self.env = encoder(model.history.encoder)
        self.q_chain, self.p_chain = Chain(model.history, 0), Chain(model.history, 1)
        steps = torch.arange(self.grid) + 0.5
        y, x = torch.meshgrid(steps, steps, indexing="ij")
        self.register_buffer("centres", torch.stack([x, y], -1).view(-1, 2) * 2 / self.grid - 1)

    # boxes

    def crop(self, image: Tensor, where: Tensor, size: int) -> Tensor:
        """Image (B, C, H, W), boxes (B, N, 4) -> (B N, C, size, size)."""
        b, n = where.shape[:2]
        sx, sy, tx, ty = where.reshape(-1, 4).unbind(-1)
        zero = torch.zeros_like(sx)
        theta = torch.stack([torch.stack([sx, zero, tx], -1), torch.stack([zero, sy, ty], -1)], 1)
        images = image[:, None].expand(b, n, *image.shape[1:]).reshape(b * n, *image.shape[1:])
        grid = F.affine_grid(theta, [b * n, image.shape[1], size, size], align_corners=False)
        return F.grid_sample(images, grid, padding_mode="zeros", align_corners=False)

    def paste(self, glimpse: Tensor, where: Tensor) -> Tensor:
        """Glimpses (N, C, g, g), boxes (N, 4) -> (N, C, H, W)."""
        sx, sy, tx, ty = where.unbind(-1)
        sx, sy = sx + 1e-9, sy + 1e-9
        zero = torch.zeros_like(sx)
        theta = torch.stack([torch.stack([1 / sx, zero, -tx / sx], -1), torch.stack([zero, 1 / sy, -ty / sy], -1)], 1)
        grid = F.affine_grid(theta, [len(where), glimpse.shape[1], self.size, self.size], align_corners=False)
        return F.grid_sample(glimpse, grid, padding_mode="zeros", align_corners=False)

    # parts

    @staticmethod
    def normal(raw: Tensor) -> Normal:
        mean, scale = raw.chunk(2, -1)
        return Normal(mean, F.softplus(scale) + 1e-4)

    @staticmethod
    def bernoulli(p: Tensor, tau: Tensor, u: Tensor) -> Tensor:
        eps = torch.finfo(p.dtype).eps
        p, u = p.clamp(eps, 1 - eps), u.clamp(eps, 1 - eps)
        y = (torch.log(p) - torch.log1p(-p) + torch.log(u) - torch.log1p(-u)) / tau
        return torch.sigmoid(y).clamp(torch.finfo(p.dtype).tiny, 1 - eps)

    @staticmethod
    def kl_bernoulli(q: Tensor, p: Tensor) -> Tensor:
        e = 1e-15
        return q * (torch.log(q + e) - torch.log(p + e)) + (1 - q) * (torch.log(1 - q + e) - torch.log(1 - p + e))

    def around(self, where: Tensor, backdrop: Tensor) -> Tensor:
        b, n = where.shape[:2]
        if self.environment == "none":
            return torch.zeros(b, n, self.q_chain.start_h.shape[0])
        if self.environment == "whole":
            return self.env(backdrop)[:, None].expand(-1, n, -1)
        more = torch.cat([where[..., :2] + self.settings["margin"], where[..., 2:]], -1)
        return self.env(self.crop(backdrop, more, self.g)).view(b, n, -1)

    def propagate(
        self, old: dict[str, Tensor], frame: Tensor, eps: Tensor, u: Tensor, tau: Tensor
    ) -> dict[str, Tensor]:
        b, m = old["ids"].shape
        _, depth, where, what, _ = self.parts(old["z"])
        h_q, h_p = old["h_q"], old["h_p"]
        mo = self.motion
        grow = mo.grow_min + (mo.grow_max - mo.grow_min) * torch.sigmoid(self.grow(h_q))
        proposal = torch.cat([where[..., :2] + grow, where[..., 2:]], -1)
        code = self.encoder(self.crop(frame, proposal, self.g)).view(b, m, -1)
        q = self.normal(self.q_dyna(torch.cat([code, h_q], -1)))
        rest, last = eps.split([5 + self.what, eps.shape[-1] - 5 - self.what], -1)
        dyna = q.mean + q.stddev * last
        out = self.change(dyna)
        p = torch.sigmoid(out[..., :1])
        d, w, a, gates = out[..., 1:].split([2, 8, 2 * self.what, 5 + self.what], -1)
        gates = torch.sigmoid(gates)
        e_d, e_w, e_a = rest.split([1, 4, self.what], -1)
        d, w, a = ((n := self.normal(x)).mean + n.stddev * e for x, e in ((d, e_d), (w, e_w), (a, e_a)))
        g_d, g_w, g_a = gates.split([1, 4, self.what], -1)
        scale = where[..., :2] + mo.scale * g_w[..., :2] * torch.tanh(w[..., :2])
        shift = where[..., 2:] + mo.shift * g_w[..., 2:] * torch.tanh(w[..., 2:])
        z = torch.cat(
            [
                old["z"][..., :1] * self.bernoulli(p, tau, u[..., None]),
                depth + mo.depth * g_d * d,
                scale,
                shift,
                what + mo.what * g_a * torch.tanh(a),
                dyna,
            ],
            -1,
        )
        kl = kl_divergence(q, self.normal(self.p_dyna(h_p))).sum((1, 2))
        around = self.around(z[..., 2:6], old["backdrop"])
        h_q, c_q = self.q_chain(z, around, h_q, old["c_q"])
        around = self.around(z[..., 2:6], old["backdrop"])  # each chain asks for itself
        h_p, c_p = self.p_chain(z, around, h_p, old["c_p"])
        return {"z": z, "h_q": h_q, "c_q": c_q, "h_p": h_p, "c_p": c_p, "ids": old["ids"], "kl": kl, "p": p[..., 0]}

    def parts(self, z: Tensor) -> tuple[Tensor, ...]:
        return z.split([1, 1, 4, self.what, z.shape[-1] - 6 - self.what], -1)

    def discover(
        self, frame: Tensor, backdrop: Tensor, kept: dict[str, Tensor] | None, eps: Tensor, u: Tensor, sched: Any
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        b, cells, what = len(frame), self.grid**2, self.what
        feature = self.resnet(torch.cat([frame, frame - backdrop], 1))
        hidden = self.q_chain.start_h.shape[0]
        tracked = torch.zeros(b, hidden, cells)
        if kept is not None:
            f = self.map_net(kept["z"]) * kept["z"][..., :1]
            distance = (kept["z"][:, :, None, 4:6] - self.centres).norm(dim=-1)
            s = self.settings["sigma_map"]
            kernel = torch.exp(-(distance**2) / (2 * s * s)) / (2 * math.pi * s * s)
            tracked = (f[:, :, None] * kernel[..., None]).sum(1).transpose(1, 2)
        seen = torch.cat([feature, tracked.reshape(b, -1, self.grid, self.grid)], 1)
        out = self.attribute_head(seen).flatten(2).transpose(1, 2)
        p = torch.sigmoid(out[..., 0])
        d, w, a = out[..., 1:].split([2, 8, 2 * what], -1)
        q_d, q_w, q_a = self.normal(d), self.normal(w), self.normal(a)
        q_y = self.normal(self.dyna_head(seen).flatten(2).transpose(1, 2))
        e_d, e_w, e_a, e_y = eps.split([1, 4, what, eps.shape[-1] - 5 - what], -1)
        pres = self.bernoulli(p, sched["temperature"], u)
        raw = q_w.mean + q_w.stddev * e_w
        where = torch.cat([torch.sigmoid(raw[..., :2]), 2 / self.grid * torch.tanh(raw[..., 2:]) + self.centres], -1)
        left = pres
        if kept is not None and self.settings["iou"] is not None:
            keep = torch.ones(b, cells)
            for i in range(b):
                box, other = where[i].detach(), kept["z"][i, :, 2:6].detach()
                other = other[kept["z"][i, :, 0] > 0.5]
                lo = torch.maximum(self.corner(box, -1)[:, None], self.corner(other, -1))
                hi = torch.minimum(self.corner(box, 1)[:, None], self.corner(other, 1))
                inter = (hi - lo).clamp(min=0).prod(-1)
                one, two = box[:, None, :2].prod(-1), other[None, :, :2].prod(-1)
                iou = inter / (one + two - inter + 1e-5) * (one != 0) * (two != 0)
                keep[i] = 1 - (iou > self.settings["iou"]).any(1).float()
            left = pres * keep
        y = q_y.mean + q_y.stddev * e_y
        z = torch.cat([left[..., None], q_d.mean + q_d.stddev * e_d, where, q_a.mean + q_a.stddev * e_a, y], -1)
        m, v = sched["scale_mean"], self.settings["scale_std"]
        prior_w = Normal(torch.stack([m, m, 0 * m, 0 * m]), torch.tensor([v, v, 1.0, 1.0]))
        unit = Normal(torch.tensor(0.0), torch.tensor(1.0))
        kls = {
            "kl_pres": self.kl_bernoulli(p, sched["presence_prior"]).sum(1),
            "kl_depth": (pres[..., None] * kl_divergence(q_d, unit)).sum((1, 2)),
            "kl_where": (pres[..., None] * kl_divergence(q_w, prior_w)).sum((1, 2)),
            "kl_what": (pres[..., None] * kl_divergence(q_a, unit)).sum((1, 2)),
            "kl_dyna": kl_divergence(q_y, unit).sum((1, 2)),
        }
        new = {"z": z}
        for name, chain in (("q", self.q_chain), ("p", self.p_chain)):
            h, c = (start.expand(b, cells, -1) for start in (chain.start_h, chain.start_c))
            new[f"h_{name}"], new[f"c_{name}"] = chain(z, self.around(where, backdrop), h, c)
        return new, kls

    @staticmethod
    def corner(box: Tensor, sign: int) -> Tensor:
        return (box[..., 2:] + 1) / 2 + sign * box[..., :2] / 2

    def select(
        self, new: dict[str, Tensor] | None, kept: dict[str, Tensor] | None, next_id: int, discovers: Tensor
    ) -> dict[str, Tensor]:
        names = ("z", "h_q", "c_q", "h_p", "c_p", "ids")
        if new is None:
            assert kept is not None
            return {name: kept[name] for name in names}
        cells = self.grid**2
        new["ids"] = torch.arange(cells).expand(len(new["z"]), -1) + next_id
        both = new if kept is None else {name: torch.cat([new[name], kept[name]], 1) for name in names}
        score = both["z"][..., 0].detach().clone()
        score[:, :cells][~discovers] = -1.0
        order = score.sort(dim=1, descending=True, stable=True).indices[:, : self.m].tolist()
        rows = []
        for best in order:
            fresh = [i for i in best if i < cells]
            if kept is not None:  # whoever was there keeps the place
                fresh = [cells + s if cells + s in best else fresh.pop(0) for s in range(self.m)]
            rows.append(fresh)
        index = torch.tensor(rows)
        picked = {
            name: both[name].gather(1, index[..., None].expand(-1, -1, both[name].shape[-1])) for name in names[:-1]
        }
        return picked | {"ids": both["ids"].gather(1, index)}

    def render(self, z: Tensor, backdrop: Tensor) -> tuple[Tensor, Tensor]:
        b, m = z.shape[:2]
        pres, depth, where, what, _ = self.parts(z)
        out = self.decoder(what.reshape(b * m, -1))
        colour, alpha = out[:, :3], out[:, 3:] * pres.reshape(-1, 1, 1, 1)
        boxes = where.reshape(-1, 4)
        a = self.paste(alpha, boxes).view(b, m, 1, self.size, self.size)
        y = self.paste(alpha * colour, boxes).view(b, m, 3, self.size, self.size)
        importance = a * torch.sigmoid(-depth)[..., None, None]
        share = importance / (importance.sum(1, keepdim=True) + 1e-5)
        return (share * y).sum(1) + (1 - (share * a).sum(1)) * backdrop, (share * a)[:, :, 0]

    def forward(self, video: Tensor, context: Context) -> dict[str, Tensor]:
        """Loss terms by name, and `masks`, `ids`, `reconstruction`."""
        b, t = video.shape[:2]
        sched, cells, each = context.schedule, self.grid**2, self.q_dyna[-1].out_features // 2 + 5 + self.what
        ctx = self.bg_q[-1].out_features // 2
        # in the model's order, so that both see the same numbers (and discover in the same frames) in training too
        source = context.noise.at(0, t)
        normal = list(source.normal(torch.empty(b * t, ctx + (cells + self.m) * each)).view(b, t, -1).unbind(1))
        uniform = list(source.uniform(torch.empty(b * t, cells + self.m + 2)).view(b, t, -1).unbind(1))
        discovers = self.who_discovers(uniform)
        h_q, c_q, h_p, c_p = (start.expand(b, -1) for start in self.bg_start)
        terms: dict[str, Any] = {}

        def add(name: str, value: Any) -> None:
            terms[name] = terms.get(name, 0) + value

        kept: dict[str, Tensor] | None = None
        results: dict[str, list[Tensor]] = {"masks": [], "ids": [], "reconstruction": []}
        for i in range(t):
            frame = video[:, i]
            e_ctx, e_cells, e_slots = normal[i].split([ctx, cells * each, self.m * each], -1)
            u_cells, u_slots, _ = uniform[i].split([cells, self.m, 2], -1)
            q = self.normal(self.bg_q(torch.cat([h_q, self.bg_encoder(frame)], -1)))
            add("kl_background", kl_divergence(q, self.normal(self.bg_p(h_p))).sum(1))
            z_ctx = q.mean + q.stddev * e_ctx
            h_q, c_q = self.bg_q_cell(z_ctx, (h_q, c_q))
            h_p, c_p = self.bg_p_cell(z_ctx, (h_p, c_p))
            backdrop = self.bg_decoder(z_ctx)
            if kept is not None:
                kept["backdrop"] = backdrop
                kept = self.propagate(kept, frame, e_slots.view(b, self.m, each), u_slots, sched["temperature"])
                add("kl_propagation", kept["kl"])
                add("presence_cost", self.kl_bernoulli(kept["p"], sched["presence_prior"]).sum(1))
            else:
                add("kl_propagation", torch.zeros(b))
                add("presence_cost", torch.zeros(b))
            new = None
            if bool(discovers[:, i].any()):
                new, kls = self.discover(frame, backdrop, kept, e_cells.view(b, cells, each), u_cells, sched)
                for name, value in kls.items():
                    add(name, value * discovers[:, i])
            kept = self.select(new, kept, 1 + i * cells, discovers[:, i])
            image, masks = self.render(kept["z"], backdrop)
            add("nll", -Normal(image, sched["sigma"]).log_prob(frame).sum((1, 2, 3)))
            for name, value in (("masks", masks), ("ids", kept["ids"]), ("reconstruction", image)):
                results[name].append(value)
        return terms | {name: torch.stack(values, 1) for name, values in results.items()}

    def who_discovers(self, uniform: list[Tensor]) -> Tensor:
        b, t = len(uniform[0]), len(uniform)
        yes = torch.ones(b, t, dtype=torch.bool)
        if not self.training:
            return yes
        rate = self.settings["dropout"]
        for i in range(b):
            drawer = 0 if self.settings["how"] == "batch" else i
            draws = [float(uniform[k][drawer, -2]) for k in range(1, t)]
            if self.settings["how"] != "balanced":
                yes[i, 1:] = torch.tensor([u >= rate for u in draws])
                continue
            expected = (1 - rate) * (t - 1)
            count = math.floor(expected) + (float(uniform[0][i, -1]) < expected - math.floor(expected))
            first = sorted(range(t - 1), key=draws.__getitem__)[:count]
            yes[i, 1:] = torch.tensor([k in first for k in range(t - 1)])
        return yes


def twins(model: Gswm, node: Mapping[str, Any]) -> dict[str, Twin]:
    """The twin that the benchmark trains, with the weights of `model`, which `node` has built."""
    naive = Naive(model)

    def terms(video: Tensor, context: Context) -> dict[str, Tensor]:
        found = naive(video, context)
        return {name: found[name] for name in model.term_names}

    return {"straightforward": Twin(model, naive, terms)}
