"""SCALOR a second time, straightforwardly: oracle of the model's tests and baseline of its benchmark.

Follows the published order of computation frame by frame: slot tensors as long as the fullest video of the batch,
spatial transformers by `affine_grid` and `grid_sample`, all three maps of a component pasted apart, everything of a
frame computed inside the loop, plain autograd. It takes the weights of an `apex_lab.models.scalor.Scalor`, of which it
runs only the stacks of layers; sizes of its draws are those of the model, so that both see the same noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from apex_lab.models.scalor import AnchoredSize, Scalor
from apex_lab.scene import Noise
from tests.reference.adapter import Twin


@dataclass
class Result:
    """terms: name -> (B,). masks: a list per frame and video of {id: (H, W)}, 0 is the background."""

    terms: dict[str, Tensor]
    masks: list[list[dict[int, Tensor]]]
    reconstruction: Tensor
    sizes: list[int] = field(default_factory=list)


def cut(image: Tensor, where: Tensor, height: int, width: int) -> Tensor:
    """Crops (N, C, height, width) of images (N, C, H, W) at z_where = (s_x, s_y, t_x, t_y)."""
    if not len(where):  # no object anywhere, which `affine_grid` refuses
        return image.new_zeros(0, image.shape[1], height, width)
    s_x, s_y, t_x, t_y = where.unbind(-1)
    zero = torch.zeros_like(s_x)
    theta = torch.stack([torch.stack([s_x, zero, t_x], -1), torch.stack([zero, s_y, t_y], -1)], 1)
    grid = F.affine_grid(theta, [len(where), image.shape[1], height, width], align_corners=False)
    return F.grid_sample(image, grid, align_corners=False)


def put(glimpse: Tensor, where: Tensor, height: int, width: int) -> Tensor:
    """The inverse: glimpses pasted into empty images."""
    if not len(where):
        return glimpse.new_zeros(0, glimpse.shape[1], height, width)
    s_x, s_y, t_x, t_y = where.unbind(-1)
    a, b, zero = 1 / (s_x + 1e-9), 1 / (s_y + 1e-9), torch.zeros_like(s_x)
    theta = torch.stack([torch.stack([a, zero, -t_x * a], -1), torch.stack([zero, b, -t_y * b], -1)], 1)
    grid = F.affine_grid(theta, [len(where), glimpse.shape[1], height, width], align_corners=False)
    return F.grid_sample(glimpse, grid, align_corners=False)


def plain(layers: nn.Module, x: Tensor) -> Tensor:
    """Layers one by one in PyTorch's default memory layout, nothing in place."""
    for layer in layers.children() if isinstance(layers, nn.Sequential) else [layers]:
        if isinstance(layer, nn.PixelShuffle):
            x = F.pixel_shuffle(x, layer.upscale_factor)
        elif isinstance(layer, nn.CELU):
            x = F.celu(x)
        else:
            x = layer(x)
    return x


def normal_kl(m: Tensor, s: Tensor, pm: Tensor, ps: Tensor) -> Tensor:
    q, p = torch.distributions.Normal(m, s), torch.distributions.Normal(pm, ps)
    return torch.distributions.kl_divergence(q, p)


def bernoulli_kl(logit: Tensor, prior: Tensor) -> Tensor:
    q, tiny = torch.sigmoid(logit), 1e-15
    return q * (torch.log(q + tiny) - torch.log(prior + tiny)) + (1 - q) * (
        torch.log(1 - q + tiny) - torch.log(1 - prior + tiny)
    )


class NaiveScalor(nn.Module):
    """The twin of a model, with the model's parameters."""

    def __init__(self, model: Scalor) -> None:
        super().__init__()
        self.model = model

    def size(self, r: Tensor) -> list[Tensor]:
        rule = self.model.objects.discovery.size
        if isinstance(rule, AnchoredSize):
            s = rule.size + rule.size_range * torch.tanh(r[:, 0])
            ratio = rule.ratio + rule.ratio_range * torch.tanh(r[:, 1])
            return [s / torch.sqrt(ratio), s * torch.sqrt(ratio)]
        low, offset = rule.smallest, rule.offset  # type: ignore[attr-defined]
        return [low + (1 - low) * torch.sigmoid(r[:, i] + offset) for i in (0, 1)]

    def encode_video(self, video: Tensor) -> list[Tensor]:
        net = self.model.encoder
        h = [torch.zeros(len(video), 64, *net.memory[0].peephole.shape[-2:]) for _ in net.memory]
        c = [torch.zeros_like(x) for x in h]
        features = []
        for t in range(video.shape[1]):
            u = plain(net.image.stack, video[:, t])
            x = plain(net.image.fuse, torch.cat([u, plain(net.image.lateral, u)], 1))
            for i, layer in enumerate(net.memory):
                xi, xf, xo, xg = layer.from_input(x).chunk(4, 1)
                hi, hf, ho, hg = layer.from_hidden(h[i]).chunk(4, 1)
                w_i, w_f, w_o = layer.peephole
                gate_i = torch.sigmoid(xi + hi + c[i] * w_i)
                gate_f = torch.sigmoid(xf + hf + c[i] * w_f)
                gate_o = torch.sigmoid(xo + ho + c[i] * w_o)
                c[i] = gate_f * c[i] + gate_i * torch.tanh(xg + hg)
                h[i] = gate_o * torch.tanh(c[i])
                x = h[i]
            features.append(x)
        return features

    def look(self, image: Tensor, where: Tensor) -> tuple[Tensor, Tensor]:
        net, g = self.model.objects.glimpse_encoder, self.model.objects.glimpse_encoder.size
        each = len(where) // len(image)
        crops = cut(image.repeat_interleave(each, 0), where, g, g)
        mean, raw = net.head(plain(net.stack, crops).flatten(1)).chunk(2, -1)
        return mean, F.softplus(raw)

    def decode(self, what: Tensor) -> tuple[Tensor, Tensor]:
        net = self.model.objects.glimpse_decoder
        features = plain(net.trunk, what[:, :, None, None])
        return torch.sigmoid(plain(net.colour, features)), torch.sigmoid(plain(net.alpha, features))

    def forward(self, video: Tensor, schedule: Mapping[str, Tensor], noise: Noise) -> Result:
        model, nets = self.model, self.model.objects
        b, t_max, _, size, _ = video.shape
        p_max = nets.max_objects if model.training else nets.evaluation_objects
        features = self.encode_video(video)
        totals = {name: torch.zeros(b) for name in model.term_names}
        state: dict[str, Tensor] | None = None  # slot tensors (B, N_t, ...)
        next_id = torch.ones(b, dtype=torch.long)
        masks, images, sizes = [], [], []
        layers = []
        for t in range(t_max):
            image, now = video[:, t], noise.at(t)
            moved = None
            if t > 0:
                moved = self.propagate(image, features[t], state, now, schedule, totals, p_max)
            a_prop = torch.zeros(b, 1, size, size) if moved is None else moved["alpha"].sum(1)
            explained = a_prop.detach().clamp(1e-15, 1 - 1e-15)
            slots = torch.zeros(b, dtype=torch.long) if state is None else (state["presence"] != 0).sum(1)[:, 0]
            new = self.discover(image, features[t], explained, now, schedule, totals, slots, t)

            alpha = torch.cat([x["alpha"] for x in (moved, new) if x is not None], 1)
            kappa = torch.cat([x["kappa"] for x in (moved, new) if x is not None], 1)
            y = torch.cat([x["y"] for x in (moved, new) if x is not None], 1)
            w = kappa / (kappa.sum(1, keepdim=True) + 1e-15)
            fore = (w * y).sum(1)
            for_mask = alpha
            if schedule["alpha_curriculum"] > 0.5:
                flat = torch.full_like(new["alpha"], 0.9)
                for_mask = flat if moved is None else torch.cat([moved["alpha"], flat], 1)
            raw = for_mask.sum(1)
            a = raw + (raw.clamp(1e-15, 1 - 1e-15) - raw).detach()
            layers.append((image, a, fore))
            sizes.append(alpha.shape[1])

            state, ids, next_id, index = self.filter(moved, new, state, next_id, schedule, p_max)
            share = alpha * w
            total = share.sum(1, keepdim=True) + 1 - a[:, None]
            share = (share / total.clamp_min(1e-15))[:, :, 0].detach()
            frame = []
            for i in range(b):
                found = {int(k): share[i, j] for k, j in zip(ids[i], index[i], strict=True)}
                found[0] = 1 - sum(found.values(), torch.zeros(size, size))
                frame.append(found)
            masks.append(frame)

        hidden, last = torch.zeros(b, model.background.prior_rnn.hidden_size), None
        for t, (image, a, fore) in enumerate(layers):
            net = model.background
            mean, raw = plain(net.encoder, torch.cat([image, 1 - a], 1)).flatten(1).chunk(2, 1)
            std = F.softplus(raw)
            z = mean + std * noise.at(t).normal(mean)
            if last is None:
                pm, ps = torch.zeros_like(mean), torch.ones_like(std)
            else:
                hidden = net.prior_rnn(last, hidden)
                delta, praw = net.prior_head(hidden).chunk(2, 1)
                pm, ps = last + delta, F.softplus(praw)
            last = z
            totals["kl_background"] = totals["kl_background"] + normal_kl(mean, std, pm, ps).sum(1)
            picture = fore + (1 - a) * torch.sigmoid(plain(net.decoder, z[:, :, None, None]))
            log_p = torch.distributions.Normal(picture, model.sigma).log_prob(image)
            totals["nll"] = totals["nll"] - log_p.sum((1, 2, 3))
            images.append(picture)
        per_video = [[masks[t][i] for t in range(t_max)] for i in range(b)]
        return Result(totals, per_video, torch.stack(images, 1), sizes)

    def propagate(
        self,
        image: Tensor,
        feature: Tensor,
        state: dict[str, Tensor],
        noise: Noise,
        schedule: Mapping[str, Tensor],
        totals: dict[str, Tensor],
        p_max: int,
    ) -> dict[str, Tensor]:
        net = self.model.objects.propagation
        b, n = state["presence"].shape[:2]
        what_size = state["what"].shape[-1]

        def normal(width: int) -> Tensor:
            return noise.normal(torch.zeros(b, p_max, width))[:, :n].flatten(0, 1)

        before = {name: x.flatten(0, 1) for name, x in state.items()}
        exists = (before["presence"] != 0).float()
        half = torch.full((b * n, 2), 0.5)
        around = torch.cat([half, before["where"][:, 2:].detach()], 1)
        small = feature.shape[-1] // 2
        seen = cut(feature.repeat_interleave(n, 0), around, small, small)
        f = net.attention_code(plain(net.attention, seen).flatten(1))
        inputs = [before[k] for k in ("where", "presence", "what", "raw")]
        h = net.tracker(net.tracker_input(torch.cat([*inputs, f], 1)), before["tracker"])

        m, s = net.where(torch.cat([h, before["what"], before["where"], before["raw"], f], 1)).chunk(2, 1)
        s = F.softplus(s - 2)
        raw = m + s * normal(4)
        centre = (before["where"][:, 2:] + 0.2 * torch.tanh(raw[:, 2:])).clamp(-1.05, 1.05)
        where = torch.cat([torch.stack(self.size(raw), 1), centre], 1)

        m_e, s_e = self.look(image, where)
        m_h, s_h = net.what(h).chunk(2, 1)
        s_h = F.softplus(s_h)
        gates = torch.sigmoid(net.gates(torch.cat([h, f], 1)))
        forget, into = gates[:, :1], gates[:, 1:]
        what_m = into * m_e + forget * m_h
        what_s = F.softplus(into * s_e + forget * s_h)
        what = what_m + what_s * normal(what_size)

        depth_m, depth_s = net.depth(torch.cat([h, what, f], 1)).chunk(2, 1)
        depth_s = F.softplus(depth_s)
        depth = depth_m + depth_s * normal(1)

        logit = 8.8 * torch.tanh(net.presence(torch.cat([h, where, raw, what], 1)) + 2)
        u = noise.uniform(torch.zeros(b, p_max, 1))[:, :n].flatten(0, 1).clamp(1.19209e-07, 1 - 1.19209e-07)
        z = torch.sigmoid((logit + torch.log(u) - torch.log(1 - u)) / schedule["temperature"])
        absent = before["absence"] + (1 - z) * exists
        z = z * (absent < 0.6).float() * exists

        prior = net.prior
        told = torch.cat([before[k] for k in ("what", "where", "raw", "depth", "presence")], 1)
        ph, pc = prior.rnn(prior.input(told), (before["prior_h"], before["prior_c"]))
        pw_m, pw_s = prior.what(ph).chunk(2, 1)
        pr_m, pr_s = prior.where(ph).chunk(2, 1)
        pd_m, pd_s = prior.depth(ph).chunk(2, 1)
        p_prob = torch.sigmoid(prior.presence(ph) + 5)

        def add(name: str, kl: Tensor) -> None:
            totals[name] = totals[name] + kl.reshape(b, -1).sum(1)

        add("kl_what", normal_kl(what_m, what_s, pw_m, F.softplus(pw_s)) * z * exists)
        add("kl_where", normal_kl(m, s, pr_m, F.softplus(pr_s)) * z * exists)
        add("kl_depth", normal_kl(depth_m, depth_s, pd_m, F.softplus(pd_s)) * z * exists)
        add("kl_pres", bernoulli_kl(logit, p_prob) * exists)

        drawn = self.render(self.decode(what), where, z, depth, b)
        slots = {
            "what": what, "where": where, "raw": raw, "depth": depth, "presence": z, "tracker": h, "prior_h": ph,
            "prior_c": pc, "absence": absent,
        }  # fmt: skip
        return drawn | {name: x.unflatten(0, (b, n)) for name, x in slots.items()}

    def render(
        self, pictures: tuple[Tensor, Tensor], where: Tensor, z: Tensor, depth: Tensor, b: int
    ) -> dict[str, Tensor]:
        size = self.model.image_size
        o, alpha = pictures
        alpha_hat = alpha * z[:, :, None, None]
        kappa = alpha_hat * torch.sigmoid(-depth)[:, :, None, None]
        return {
            "alpha": put(alpha_hat, where, size, size).unflatten(0, (b, -1)),
            "kappa": put(kappa, where, size, size).unflatten(0, (b, -1)),
            "y": put(alpha_hat * o, where, size, size).unflatten(0, (b, -1)),
        }

    def discover(
        self,
        image: Tensor,
        feature: Tensor,
        explained: Tensor,
        noise: Noise,
        schedule: Mapping[str, Tensor],
        totals: dict[str, Tensor],
        slots: Tensor,
        t: int,
    ) -> dict[str, Tensor]:
        net, b = self.model.objects.discovery, len(image)
        g = net.grid
        q = plain(net.fusion, torch.cat([feature, plain(net.mask_encoder, explained)], 1))

        def per_cell(head: nn.Module) -> Tensor:
            return plain(head, q).permute(0, 2, 3, 1).flatten(0, 2)

        def normal(width: int) -> Tensor:
            return noise.normal(torch.zeros(b, g * g, width)).flatten(0, 1)

        m, s = per_cell(net.where).chunk(2, 1)
        s = F.softplus(s)
        raw = m + s * normal(4)
        column = torch.arange(g).repeat(g).repeat(b)
        row = torch.arange(g).repeat_interleave(g).repeat(b)
        t_x = 2 / g * (column + 0.5 + torch.tanh(raw[:, 2])) - 1
        t_y = 2 / g * (row + 0.5 + torch.tanh(raw[:, 3])) - 1
        where = torch.stack([*self.size(raw), t_x, t_y], 1)
        what_m, what_s = self.look(image, where)
        what = what_m + what_s * normal(what_m.shape[1])
        depth_m, depth_s = per_cell(net.depth).chunk(2, 1)
        depth_s = F.softplus(depth_s)
        depth = depth_m + depth_s * normal(1)
        logit = 8.8 * torch.tanh(per_cell(net.presence))
        u = noise.uniform(torch.zeros(b, g * g, 1)).flatten(0, 1).clamp(1.19209e-07, 1 - 1.19209e-07)
        z0 = torch.sigmoid((logit + torch.log(u) - torch.log(1 - u)) / schedule["temperature"])

        pictures = self.decode(what)  # before the decisions, which need alpha
        z, keep = z0, torch.ones_like(z0)
        if t > 0:
            with torch.no_grad():
                alpha = pictures[1]
                size = self.model.image_size
                mine = (put(alpha, where, size, size) > 0.3).float()
                theirs = (explained > 0.1).float().repeat_interleave(g * g, 0)
                ratio = (mine * theirs).sum((1, 2, 3)) / (mine.sum((1, 2, 3)) + 1e-15)
                keep = (ratio < 0.3).float()[:, None]
            z = z * keep
        if self.model.training:
            z = self.cap(z.unflatten(0, (b, -1))[:, :, 0], slots).flatten()[:, None]

        def add(name: str, kl: Tensor) -> None:
            totals[name] = totals[name] + kl.reshape(b, -1).sum(1)

        for name, mean, std in (("what", what_m, what_s), ("where", m, s), ("depth", depth_m, depth_s)):
            add(f"kl_{name}", normal_kl(mean, std, torch.zeros_like(mean), torch.ones_like(std)) * z0)
        prior = schedule["discovery_presence"] * keep + 1e-8 * (1 - keep)
        add("kl_pres", bernoulli_kl(logit, prior))

        def zeros(width: int) -> Tensor:
            return torch.zeros(b * g * g, width)

        drawn = self.render(pictures, where, z, depth, b)
        slots_of = {
            "what": what, "where": where, "raw": zeros(4), "depth": depth, "presence": z, "tracker": zeros(128),
            "prior_h": zeros(64), "prior_c": zeros(64), "absence": zeros(1),
        }  # fmt: skip
        return drawn | {name: x.unflatten(0, (b, -1)) for name, x in slots_of.items()}

    def cap(self, z: Tensor, slots: Tensor) -> Tensor:
        rows = []
        for i in range(len(z)):
            n = self.model.objects.max_objects - int(slots[i])
            if n >= z.shape[1]:
                rows.append(z[i])
                continue
            limit = sorted(z[i].tolist(), reverse=True)[n]
            rows.append(z[i] * (z[i].detach() > limit).float())
        return torch.stack(rows)

    def filter(
        self,
        moved: dict[str, Tensor] | None,
        new: dict[str, Tensor],
        state: dict[str, Tensor] | None,
        next_id: Tensor,
        schedule: Mapping[str, Tensor],
        p_max: int,
    ) -> tuple[dict[str, Tensor], list[list[int]], Tensor, list[list[int]]]:
        """The slots of the next frame, by loops over videos and candidates."""
        names = ("what", "where", "raw", "depth", "presence", "tracker", "prior_h", "prior_c", "absence")
        b = len(new["presence"])
        old = 0 if moved is None else moved["presence"].shape[1]
        kept: list[list[tuple[int, int]]] = []
        stays = None if moved is None else moved["presence"].detach()
        arrives = new["presence"].detach()
        for i in range(b):
            mine = []
            for k in range(old):
                if float(stays[i, k]) > 0:
                    mine.append((k, int(state["ids"][i, k])))
            cells = [c for c in range(new["presence"].shape[1]) if float(arrives[i, c]) > self.model.objects.track]
            strongest = sorted(cells, key=lambda c: -float(arrives[i, c]))[: p_max - len(mine)]
            for c in sorted(strongest):
                mine.append((old + c, int(next_id[i])))
                next_id[i] += 1
            kept.append(mine)
        longest = max(len(mine) for mine in kept)
        after: dict[str, Tensor] = {}
        for name in names:
            whole = new[name] if moved is None else torch.cat([moved[name], new[name]], 1)
            rows = []
            for i in range(b):
                row = [whole[i, j] for j, _ in kept[i]]
                row += [torch.zeros_like(whole[i, 0])] * (longest - len(row))
                rows.append(torch.stack(row) if row else whole[i, :0])
            after[name] = torch.stack(rows)
            if schedule["slot_gradient"] <= 0.5:
                after[name] = after[name].detach()
        ids = [[k for _, k in mine] for mine in kept]
        after["ids"] = torch.tensor([row + [-1] * (longest - len(row)) for row in ids]).reshape(b, longest, 1)
        return after, ids, next_id, [[j for j, _ in mine] for mine in kept]


def twins(model: Scalor, node: Mapping[str, Any]) -> dict[str, Twin]:
    """The twin that the benchmark trains, with the weights of `model`, which `node` has built."""
    naive = NaiveScalor(model)
    return {
        "straightforward": Twin(
            model, naive, lambda video, context: naive(video, context.schedule, context.noise).terms
        )
    }
