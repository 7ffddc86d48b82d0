"""SPACE as one would write it down first: oracle of `models.space`'s tests and baseline of its benchmark.

A second, independent implementation of space.md in the published form: every crop and paste is an `affine_grid` and a
`grid_sample` with a full-size image for every cell and channel, the mixture is a `logsumexp`, the broadcast decoder
decodes broadcast maps, all K masks are decoded, and autograd differentiates everything. Only the noise's order of
draws and the names of loss terms are shared with the model.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from apex_lab.models.space import Space
from apex_lab.scene import Context, Scene
from tests.reference.adapter import Twin


def celu(cin: int, cout: int, k: int, s: int, p: int, groups: int) -> list[nn.Module]:
    return [nn.Conv2d(cin, cout, k, s, p), nn.CELU(), nn.GroupNorm(groups, cout)]


def elu(cin: int, cout: int, s: int, p: int) -> list[nn.Module]:
    return [nn.Conv2d(cin, cout, 3, s, p), nn.BatchNorm2d(cout), nn.ELU()]


def up(cin: int, cout: int, r: int, groups: int) -> list[nn.Module]:
    first = [nn.Conv2d(cin, cout * r * r, 1), nn.PixelShuffle(r), nn.CELU(), nn.GroupNorm(groups, cout)]
    return [*first, *celu(cout, cout, 3, 1, 1, groups)]


FACTORS = {128: (4, 2, 4, 4), 64: (4, 2, 4, 2), 32: (4, 2, 2, 2)}
STRONG_FACTORS = {128: (4, 4, 2, 4), 64: (4, 4, 2, 2), 32: (4, 2, 2, 2)}


def crop(image: Tensor, where: Tensor, size: int) -> Tensor:
    """image (m, C, H, W), where (m, 4) as (sx, sy, tx, ty) -> (m, C, size, size)."""
    sx, sy, tx, ty = where.unbind(-1)
    zero = torch.zeros_like(sx)
    theta = torch.stack([torch.stack([sx, zero, tx], -1), torch.stack([zero, sy, ty], -1)], dim=-2)
    grid = F.affine_grid(theta, [len(image), image.shape[1], size, size], align_corners=False)
    return F.grid_sample(image, grid, mode="bilinear", padding_mode="zeros", align_corners=False)


def paste(glimpse: Tensor, where: Tensor, size: int) -> Tensor:
    """glimpse (m, C, g, g), where (m, 4) as (sx, sy, tx, ty) -> (m, C, size, size)."""
    scale, shift = where[:, :2] + 1e-9, where[:, 2:]
    return crop(glimpse, torch.cat([1 / scale, -shift / scale], dim=-1), size)


def kl_normal(mean: Tensor, std: Tensor, prior_mean: Tensor | float, prior_std: Tensor | float) -> Tensor:
    q, p = torch.distributions.Normal(mean, std), torch.distributions.Normal(prior_mean, prior_std)
    return torch.distributions.kl_divergence(q, p)


def log_normal(x: Tensor, mean: Tensor, std: float) -> Tensor:
    return torch.distributions.Normal(mean, std).log_prob(x)


FOREGROUND = ("trunk", "lateral", "merge", "heads", "what_encoder", "what_decoder", "rgb", "mask.")
"""Beginnings of the names of what `NaiveSpace._build_foreground` makes."""


class NaiveSpace(nn.Module):
    """Takes the weights of a `Space`, by the order in which both define their layers."""

    def __init__(self, model: Space, image_size: int, grid: int, components: int = 5, **sizes: Any) -> None:
        super().__init__()
        self.size, self.grid, self.k = image_size, grid, components
        self.sigma_fg, self.sigma_bg = sizes.get("sigma_fg", 0.15), sizes.get("sigma_bg", 0.15)
        self.scale_std, width = sizes.get("scale_std", 0.1), sizes.get("decoder_width", 32)
        self._build_foreground(image_size // grid)
        self._build_background(image_size, width)
        self.copy(model)

    def _build_foreground(self, ratio: int) -> None:
        s4, s5 = {8: (1, 1), 16: (1, 2), 32: (2, 2)}[ratio]
        self.trunk = nn.Sequential(
            *celu(3, 16, 4, 2, 1, 4),
            *celu(16, 32, 4, 2, 1, 8),
            *celu(32, 64, 4, 2, 1, 8),
            *celu(64, 128, 3, s4, 1, 16),
            *celu(128, 256, 3, s5, 1, 32),
            *celu(256, 128, 1, 1, 0, 16),
        )
        self.lateral = nn.Sequential(*celu(128, 128, 3, 1, 1, 16), *celu(128, 128, 3, 1, 1, 16))
        self.merge = nn.Sequential(*celu(256, 128, 3, 1, 1, 16))
        self.heads = nn.ModuleList([nn.Conv2d(128, outputs, 1) for outputs in (1, 2, 4, 4)])
        self.what_encoder = nn.Sequential(
            *celu(3, 16, 3, 1, 1, 4),
            *celu(16, 32, 4, 2, 1, 8),
            *celu(32, 32, 3, 1, 1, 4),
            *celu(32, 64, 4, 2, 1, 8),
            *celu(64, 128, 4, 2, 1, 8),
            *celu(128, 256, 4, 1, 0, 16),
            nn.Flatten(),
            nn.Linear(256, 64),
        )
        self.what_decoder = nn.Sequential(
            *celu(32, 256, 1, 1, 0, 16),
            *up(256, 128, 2, 16),
            *up(128, 128, 2, 16),
            *up(128, 64, 2, 8),
            *up(64, 32, 2, 8),
            *up(32, 16, 2, 4),
        )
        self.rgb, self.mask = nn.Conv2d(16, 3, 3, padding=1), nn.Conv2d(16, 1, 3, padding=1)

    def _build_background(self, size: int, width: int) -> None:
        flat = 64 * (size // 16) ** 2
        self.bg_encoder = nn.Sequential(
            *elu(3, 64, 2, 1), *elu(64, 64, 2, 1), *elu(64, 64, 2, 1), *elu(64, 64, 2, 1), nn.Flatten(),
            nn.Linear(flat, 64), nn.ELU(),
        )  # fmt: skip
        self.start = nn.ParameterList([nn.Parameter(torch.zeros(n)) for n in (32, 64, 64, 64, 64)])
        self.q_lstm, self.q_head = nn.LSTMCell(96, 64), nn.Linear(64, 64)
        self.p_lstm, self.p_head = nn.LSTMCell(32, 64), nn.Linear(64, 64)
        r = FACTORS[size]
        self.mask_decoder = nn.Sequential(
            *celu(32, 256, 1, 1, 0, 16), *up(256, 256, r[0], 16), *up(256, 128, r[1], 16), *up(128, 64, r[2], 8),
            *up(64, 16, r[3], 4), *celu(16, 16, 3, 1, 1, 4), nn.Conv2d(16, 1, 3, padding=1), nn.Sigmoid(),
        )  # fmt: skip
        self.comp_encoder = nn.Sequential(
            *elu(4, 32, 2, 1), *elu(32, 32, 2, 1), *elu(32, 64, 2, 1), *elu(64, 64, 2, 1), nn.Flatten(),
            nn.Linear(flat, 64),
        )  # fmt: skip
        self.comp_prior = nn.Sequential(
            nn.Linear(32, 64), nn.ELU(), nn.Linear(64, 64), nn.ELU(), nn.Linear(64, 64)
        )  # fmt: skip
        r = STRONG_FACTORS[size]
        self.comp_decoder = nn.Sequential(
            *elu(34, width, 1, 0), *elu(width, width, 1, 0), *elu(width, width, 1, 0), *elu(width, width, 1, 0),
            nn.Conv2d(width, 3, 1), nn.Sigmoid(),
        ) if self.k > 1 else nn.Sequential(
            *celu(32, 256, 1, 1, 0, 16), *up(256, 256, r[0], 16), *up(256, 128, r[1], 16), *up(128, 64, r[2], 8),
            *up(64, 16, r[3], 4), *celu(16, 16, 3, 1, 1, 4), nn.Conv2d(16, 3, 3, padding=1), nn.Sigmoid(),
        )  # fmt: skip

    def pairs(self, model: Space) -> list[tuple[nn.Module | nn.Parameter, nn.Module | nn.Parameter]]:
        """(mine, the model's) modules and parameters with the same weights."""
        fg, bg = model.foreground, model.background
        return [
            (self.trunk, fg.encoder.trunk),
            (self.lateral, fg.encoder.lateral),
            (self.merge, fg.encoder.merge),
            *zip(self.heads, (fg.presence, fg.depth, fg.scale, fg.shift), strict=True),
            (self.what_encoder, fg.glimpse_encoder),
            (self.what_decoder, fg.glimpse_decoder.trunk),
            (self.rgb, fg.glimpse_decoder.colour),
            (self.mask, fg.glimpse_decoder.mask),
            (self.bg_encoder, bg.image_encoder),
            (self.start[0], bg.start_mask),
            (self.start[1], bg.mask_posterior.start_hidden),
            (self.start[2], bg.mask_posterior.start_cell),
            (self.start[3], bg.mask_prior.start_hidden),
            (self.start[4], bg.mask_prior.start_cell),
            (self.q_lstm, bg.mask_posterior.cell),
            (self.q_head, bg.mask_posterior.head),
            (self.p_lstm, bg.mask_prior.cell),
            (self.p_head, bg.mask_prior.head),
            (self.mask_decoder, bg.mask_decoder),
            (self.comp_encoder, bg.component_encoder),
            (self.comp_prior, bg.component_prior),
            (self.comp_decoder, bg.component_decoder),
        ]

    def parameter_pairs(self, model: Space) -> list[tuple[Tensor, str, Tensor]]:
        """(mine, the model's name, the model's) parameters."""
        names = {id(p): name for name, p in model.named_parameters()}
        found = []
        for mine, theirs in self.pairs(model):
            mine_all = [mine] if isinstance(mine, nn.Parameter) else list(mine.parameters())
            their_all = [theirs] if isinstance(theirs, nn.Parameter) else list(theirs.parameters())
            found += [(a, names[id(b)], b) for a, b in zip(mine_all, their_all, strict=True)]
        return found

    def copy(self, model: Space) -> None:
        """Takes the model's weights and running statistics."""
        with torch.no_grad():
            for mine, _, theirs in self.parameter_pairs(model):
                assert mine.shape == theirs.shape
                mine.copy_(theirs)
        for mine, theirs in self.pairs(model):
            if isinstance(mine, nn.Module) and isinstance(theirs, nn.Module):
                norms = [[m for m in x.modules() if isinstance(m, nn.BatchNorm2d)] for x in (mine, theirs)]
                for a, b in zip(*norms, strict=True):
                    a.load_state_dict(b.state_dict())

    def forward(self, video: Tensor, context: Context) -> Scene:
        x, schedule, noise = video.flatten(0, 1), context.schedule, context.noise.at(0, video.shape[1])
        fg, bg = self.foreground(x, schedule, noise), self.background(x, noise)
        alpha, mu_fg, pi, mu = fg["alpha"], fg["mean"], bg["pi"], bg["mu"]
        mixing = alpha
        if schedule["fix_alpha"] == 1:
            mixing = torch.full_like(alpha, float(schedule["fixed_alpha"]))
        each = log_normal(x[:, None], mu, self.sigma_bg) + torch.log(pi + 1e-5)
        ell_bg = torch.logsumexp(each, dim=1) + torch.log(1 - mixing + 1e-5)
        ell_fg = log_normal(x, mu_fg, self.sigma_fg) + torch.log(mixing + 1e-5)
        log_like = torch.logsumexp(torch.stack([ell_fg, ell_bg]), dim=0).sum((1, 2, 3))
        terms = {"nll": -log_like, **fg["terms"], **bg["terms"]}
        b, cells = len(video), fg["masks"].shape[1]
        masks = torch.cat([fg["masks"], 1 - alpha], dim=1)

        def video_of(values: Tensor) -> Tensor:
            return values.unflatten(0, (b, -1))

        return Scene(
            masks=video_of(masks),
            background=torch.arange(cells + 1) == cells,
            ids=torch.tensor([*range(1, cells + 1), 0]).expand(*video.shape[:2], -1),
            presence=video_of(torch.cat([fg["q_pres"], torch.ones(len(x), 1)], dim=1)),
            appearance=video_of(torch.cat([fg["what"], torch.zeros_like(fg["what"][:, :1])], dim=1)),
            reconstruction=video_of(mixing * mu_fg + (1 - mixing) * (pi * mu).sum(1)),
            terms={name: video_of(term).sum(1) for name, term in terms.items()},
        )

    def foreground(self, x: Tensor, schedule: Any, noise: Any) -> dict[str, Any]:
        n, cells = len(x), self.grid**2
        features = self.trunk(x)
        features = self.merge(torch.cat([features, self.lateral(features)], dim=1))
        pres, depth, scale, shift = (head(features).permute(0, 2, 3, 1).reshape(n, cells, -1) for head in self.heads)
        logit = 8.8 * torch.tanh(pres[..., 0])
        eps = torch.finfo(torch.float32).eps
        u = noise.uniform(logit).clamp(eps, 1 - eps)
        z_pres = torch.sigmoid((logit + torch.log(u) - torch.log1p(-u)) / schedule["temperature"])
        depth_mean, depth_std = depth[..., :1], F.softplus(depth[..., 1:])
        z_depth = depth_mean + depth_std * noise.normal(depth_mean)
        scale_mean, scale_std = scale[..., :2], F.softplus(scale[..., 2:]) + 1e-15
        z_scale = torch.sigmoid(scale_mean + scale_std * noise.normal(scale_mean))
        # z_shift's and z_scale's components are x, y as published; the model flips them, so noise is in this order
        shift_mean, shift_std = shift[..., :2], F.softplus(shift[..., 2:])
        raw_shift = torch.tanh(shift_mean + shift_std * noise.normal(shift_mean))
        z_shift = torch.empty_like(raw_shift)
        for i in range(self.grid):
            for j in range(self.grid):
                cell = raw_shift.new_tensor([j, i])
                z_shift[:, i * self.grid + j] = 2 / self.grid * (cell + 0.5 + raw_shift[:, i * self.grid + j]) - 1
        where = torch.cat([z_scale, z_shift], dim=-1).reshape(n * cells, 4)
        glimpses = crop(x.repeat_interleave(cells, dim=0), where, 32)
        what = self.what_encoder(glimpses).reshape(n, cells, -1)
        what_mean, what_std = what[..., :32], F.softplus(what[..., 32:])
        z_what = what_mean + what_std * noise.normal(what_mean)
        decoded = self.what_decoder(z_what.reshape(n * cells, 32, 1, 1))
        colour, mask = torch.sigmoid(self.rgb(decoded)), torch.sigmoid(self.mask(decoded))
        ahat = mask * z_pres.reshape(-1, 1, 1, 1)
        importance = 100 * ahat * torch.sigmoid(-z_depth.reshape(-1, 1, 1, 1))
        weight = torch.softmax(paste(importance, where, self.size).reshape(n, cells, 1, self.size, self.size), dim=1)
        full_mask = paste(ahat, where, self.size).reshape(n, cells, 1, self.size, self.size)
        full_colour = paste(ahat * colour, where, self.size).reshape(n, cells, 3, self.size, self.size)
        alpha, mean = (weight * full_mask).sum(1), (weight * full_colour).sum(1)

        kernel = torch.full((1, 1, 32, 32), 1 / 1024)
        kernel[..., 6:26, 6:26] = 0
        rims = paste(kernel * z_pres.reshape(-1, 1, 1, 1), where, self.size).reshape(n, cells, 1, self.size, self.size)
        boundary = -torch.distributions.Normal(0.0, 0.7).log_prob(1000 * rims.sum(1) * alpha).sum((1, 2, 3))
        q, p = torch.sigmoid(logit), schedule["presence_prior"]
        kl_pres = q * (torch.log(q + 1e-15) - torch.log(p + 1e-15))
        kl_pres = kl_pres + (1 - q) * (torch.log(1 - q + 1e-15) - torch.log(1 - p + 1e-15))
        kl_where = kl_normal(scale_mean, scale_std, schedule["scale_prior"], self.scale_std)
        kl_where = kl_where.sum((1, 2)) + kl_normal(shift_mean, shift_std, 0.0, 1.0).sum((1, 2))
        terms = {
            "kl_pres": kl_pres.sum(1),
            "kl_depth": kl_normal(depth_mean, depth_std, 0.0, 1.0).sum((1, 2)),
            "kl_where": kl_where,
            "kl_what": kl_normal(what_mean, what_std, 0.0, 1.0).sum((1, 2)),
            "boundary": boundary,
        }
        masks = (weight * full_mask).squeeze(2)
        return {"alpha": alpha, "mean": mean, "masks": masks, "q_pres": q, "what": z_what, "terms": terms}

    def background(self, x: Tensor, noise: Any) -> dict[str, Any]:
        n = len(x)
        code = self.bg_encoder(x)
        z, q_h, q_c, p_h, p_c = (start.expand(n, -1) for start in self.start)
        kl_mask, z_masks, u = torch.zeros(n), [], []
        for k in range(self.k):
            q_h, q_c = self.q_lstm(torch.cat([z, code], dim=1), (q_h, q_c))
            mean, raw = self.q_head(q_h).chunk(2, dim=1)
            if k > 0:
                p_h, p_c = self.p_lstm(z, (p_h, p_c))
            prior_mean, prior_raw = self.p_head(p_h).chunk(2, dim=1)
            std, prior_std = F.softplus(raw) + 1e-4, F.softplus(prior_raw) + 1e-4
            z = mean + std * noise.normal(mean)
            kl_mask = kl_mask + kl_normal(mean, std, prior_mean, prior_std).sum(1)
            z_masks.append(z)
            u.append(self.mask_decoder(z[..., None, None]))
        remaining, pi = torch.ones_like(u[0]), []
        for k in range(self.k):
            pi.append(u[k] * remaining if k < self.k - 1 else remaining)
            remaining = remaining - pi[-1]
        pis = torch.stack(pi, dim=1)
        inputs = torch.cat([torch.log(pis + 1e-5), x[:, None].expand(-1, self.k, -1, -1, -1)], dim=2)
        mean, raw = self.comp_encoder(inputs.flatten(0, 1)).reshape(n, self.k, -1).chunk(2, dim=2)
        prior_mean, prior_raw = self.comp_prior(torch.stack(z_masks, dim=1)).chunk(2, dim=2)
        std, prior_std = F.softplus(raw) + 1e-4, F.softplus(prior_raw) + 1e-4
        z_comp = (mean + std * noise.normal(mean)).flatten(0, 1)[..., None, None]
        if self.k > 1:
            side = self.size + 8
            ramp = torch.linspace(-1, 1, side)
            across, down = ramp.expand(side, side), ramp[:, None].expand(side, side)
            coordinates = torch.stack([across, down]).expand(len(z_comp), -1, -1, -1)
            z_comp = torch.cat([z_comp.expand(-1, -1, side, side), coordinates], dim=1)
        mu = self.comp_decoder(z_comp).reshape(n, self.k, 3, self.size, self.size)
        kl_component = kl_normal(mean, std, prior_mean, prior_std).sum((1, 2))
        return {"pi": pis, "mu": mu, "terms": {"kl_mask": kl_mask, "kl_component": kl_component}}


def relative_error(found: Tensor, expected: Tensor) -> float:
    """Largest difference, relative to the largest expected magnitude."""
    return ((found - expected).abs().max() / expected.abs().max().clamp_min(1e-12)).item()


def twins(model: Space, node: Mapping[str, Any]) -> dict[str, Twin]:
    """The twin that the benchmark trains, with the weights of `model`; none for glimpses of other sizes than 32."""
    if node.get("glimpse_size", 32) != 32:
        return {}
    names = ("sigma_fg", "sigma_bg", "scale_std", "decoder_width")
    sizes = {name: node[name] for name in names if name in node}
    naive = NaiveSpace(model, model.image_size, node["grid"], node["components"], **sizes)
    return {"straightforward": Twin(model, naive, lambda video, context: naive(video, context).terms, _group)}


def _group(name: str) -> str:
    """The optimiser's group of a parameter of the twin."""
    return "foreground." if name.startswith(FOREGROUND) else "background."
