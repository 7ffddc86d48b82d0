"""APEX written out a second time, the slow way, straight from the paper and in its order.

One video in float64, objects in a Python list, PyTorch's own spatial transformer, masks and likelihood in plain
exponentials, sums as loops. Only the networks are the model's. Latents are means and presence is a decision, as in
evaluation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from apex_lab.models.apex import Apex, ApexNormalisation, MixtureLikelihood

TERMS = ("nll", "kl_what", "kl_where", "kl_pres", "kl_background", "mask_entropy")


def paste(glimpse: Tensor, window: Tensor, size: int) -> Tensor:
    """(C, g, g) through the inverse of a window into an empty image, (C, size, size)."""
    s_y, s_x, t_y, t_x = window
    zero = torch.zeros_like(s_y)
    theta = torch.stack([torch.stack([1 / s_x, zero, -t_x / s_x]), torch.stack([zero, 1 / s_y, -t_y / s_y])])
    grid = F.affine_grid(theta[None], [1, len(glimpse), size, size], align_corners=False)
    return F.grid_sample(glimpse[None], grid, align_corners=False)[0]


def cut(image: Tensor, window: Tensor, size: int) -> Tensor:
    """A window of (C, h, w) as (C, size, size)."""
    s_y, s_x, t_y, t_x = window
    zero = torch.zeros_like(s_y)
    theta = torch.stack([torch.stack([s_x, zero, t_x]), torch.stack([zero, s_y, t_y])])
    grid = F.affine_grid(theta[None], [1, len(image), size, size], align_corners=False)
    return F.grid_sample(image[None], grid, align_corners=False)[0]


def kl_normal(a: tuple[Tensor, Tensor], b: tuple[Tensor, Tensor]) -> float:
    """KL(a || b) of diagonal Gaussians (mean, standard deviation), number by number."""
    rows = zip(*(x.tolist() for x in (*a, *b)), strict=True)
    return sum(math.log(t / s) + (s**2 + (m - n) ** 2) / (2 * t**2) - 0.5 for m, s, n, t in rows)


def kl_presence(q: float, p: float) -> float:
    """KL of two Bernoulli distributions whose probabilities are kept 1e-6 from 0 and 1."""
    q, p = (min(max(x, 1e-6), 1 - 1e-6) for x in (q, p))
    return q * math.log(q / p) + (1 - q) * math.log((1 - q) / (1 - p))


def normal(raw: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation from a head's output."""
    mean, spread = raw.chunk(2, dim=-1)
    return mean, (torch.log1p(spread.exp()) + 1e-3).clamp_max(5.0)


def appearance(model: Apex, hidden: Tensor, code: Tensor) -> tuple[Tensor, Tensor]:
    """q(z_what) of one object; the glimpse's code goes past the RNN where the model has that shortcut."""
    return normal(model.appearance.head(torch.cat([hidden, code]) if model.glimpses.shortcut else hidden))


def frame_masks(
    alphas: list[Tensor], presences: list[Tensor], windows: list[Tensor], c: float, size: int
) -> tuple[list[Tensor], Tensor, Tensor]:
    """Eq. 8-12: masks of the objects, foreground mask, background mask."""
    s = windows_total = torch.zeros(size, size, dtype=torch.float64)
    powers = []
    for alpha, presence, window in zip(alphas, presences, windows, strict=True):
        s = s + paste((torch.log(1 + alpha.exp()) * presence)[None], window, size)[0]
        powers.append((paste(alpha[None], window, size)[0] + 2 * c * presence).exp())
    m_fg = torch.tanh(s)
    total = sum(powers, windows_total)
    return [power / total * m_fg for power in powers], m_fg, 1 - m_fg


def log_likelihood(
    image: Tensor,
    masks: list[Tensor],
    means: list[Tensor],
    backdrops: list[Tensor],
    likelihood: MixtureLikelihood,
    scales: tuple[float, float],
) -> float:
    """Eq. 1, pixel by pixel and channel by channel; the last mask is the background's, whose images are alike likely.

    scales: what sigma_fg and sigma_bg are multiplied by.
    """
    sigmas = [likelihood.sigma_fg * scales[0]] * len(means) + [likelihood.sigma_bg * scales[1]] * len(backdrops)
    masks = [*masks[:-1], *[masks[-1] / len(backdrops)] * len(backdrops)]
    means = [*means, *backdrops]
    flat_masks = [m.flatten().tolist() for m in masks]
    total = 0.0
    for channel in range(3):
        flat_means = [m[channel].flatten().tolist() for m in means]
        for pixel, x in enumerate(image[channel].flatten().tolist()):
            p = 0.0
            for m, mean, sigma in zip(flat_masks, flat_means, sigmas, strict=True):
                z = (x - mean[pixel]) / sigma
                p += m[pixel] * math.exp(-0.5 * z * z) / (sigma * math.sqrt(2 * math.pi))
            total += math.log(p)
    return total


def entropy(masks: list[Tensor], m_fg: Tensor) -> float:
    """Eq. 21 of one frame."""
    total = 0.0
    for mask in masks:
        for m, fg in zip(mask.flatten().tolist(), m_fg.flatten().tolist(), strict=True):
            total -= fg * m * math.log(m) if m > 0 else 0.0
    return total


@dataclass
class Thing:
    """An object: its identity, latents and recurrent states."""

    identity: int
    what: Tensor
    place: Tensor
    present: bool
    hidden: dict[str, Tensor]

    @property
    def window(self) -> Tensor:
        return torch.cat([torch.sigmoid(self.place[:2]), self.place[2:]])


@dataclass
class Told:
    """What the slow APEX says about a video."""

    terms: dict[str, float] = field(default_factory=lambda: dict.fromkeys(TERMS, 0.0))
    slots: list[list[int]] = field(default_factory=list)
    masks: list[dict[int, Tensor]] = field(default_factory=list)
    pictures: list[Tensor] = field(default_factory=list)
    contexts: list[float] = field(default_factory=list)


def recur(cell: torch.nn.GRUCell, hidden: Tensor, *inputs: Tensor) -> Tensor:
    return cell(torch.cat(inputs)[None], hidden[None])[0]


def mask_logits(model: Apex, what: Tensor) -> Tensor:
    assert isinstance(model.masks, ApexNormalisation)
    return model.masks.c * torch.tanh(model.mask_decoder(what[None])[0, 0])  # Eq. 7


def propagate(model: Apex, e: Tensor, thing: Thing, told: Told) -> Thing:
    """Eq. 15 and Eq. 5 of one object, and what it costs."""
    net, glimpses = model.propagation, model.glimpses
    old, presence = thing.window, torch.tensor([float(thing.present)], dtype=torch.float64)
    prior = recur(net.rnn_prior, thing.hidden["prior"], thing.what, old, presence)

    side = max(old[0], old[1])
    square = torch.stack([side, side, old[2], old[3]])
    c_p = glimpses.propagation(cut(e, square, glimpses.size)[None])[0]
    where = recur(net.rnn_where, thing.hidden["where"], c_p, thing.what, old)
    q_where = normal(net.head_where(where))
    step = torch.tanh(q_where[0])
    limits = torch.tensor([net.windows.size_step] * 2 + [net.windows.centre_step] * 2, dtype=torch.float64)
    bounds = torch.tensor([4.0, 4.0, 1.0, 1.0], dtype=torch.float64)
    moved = replace(thing, place=torch.minimum(torch.maximum(thing.place + limits * step, -bounds), bounds))

    code = glimpses.glimpse(cut(e, moved.window, glimpses.size)[None])[0]
    what = recur(model.appearance.rnn, thing.hidden["what"], code, thing.what)
    q_what = appearance(model, what, code)
    pres = recur(net.rnn_pres, thing.hidden["pres"], c_p, q_what[0], presence)
    q_pres = float(torch.sigmoid(net.head_pres(pres)))

    moved = replace(
        moved,
        what=q_what[0],
        present=q_pres > 0.5,
        hidden={"prior": prior, "where": where, "what": what, "pres": pres},
    )
    told.terms["kl_pres"] += kl_presence(q_pres, float(torch.sigmoid(net.prior_pres(prior))))
    if moved.present:
        told.terms["kl_what"] += kl_normal(normal(net.prior_what(prior)), q_what)
        told.terms["kl_where"] += kl_normal(normal(net.prior_where(prior)), q_where)
    return moved


def decoded(model: Apex, z: Tensor) -> Tensor:
    """z_bg -> (3, H, W)."""
    logit = model.background.decoder(z[None])[0]
    if model.background.change == "shade":
        logit = torch.log(2 / (1 + torch.exp(-logit)))
    return torch.sigmoid(logit + model.background.bias_image)


def looks(model: Apex, backdrop: Tensor, image: Tensor) -> list[Tensor]:
    """What each pixel of the background may look like: as decoded, and with the image's cast shadow on it."""
    darkest = model.background.shadow
    if darkest == 1:
        return [backdrop]
    dark = backdrop.clone()
    for y in range(dark.shape[1]):
        for x in range(dark.shape[2]):
            b, seen = backdrop[:, y, x].tolist(), image[:, y, x].tolist()
            u = sum(p * q for p, q in zip(b, seen, strict=True)) / sum(p * p for p in b)
            dark[:, y, x] *= min(max(u, darkest), 1.0)
    return [backdrop, dark]


def discover(model: Apex, e: Tensor, scope: Tensor, p0: float, told: Told) -> list[Thing]:
    """Eq. 16-18 and Eq. 6 of all cells; the rendered ones that are present, the most probable first."""
    net, glimpses, g, size = model.discovery, model.glimpses, model.discovery.grid, model.image_size
    found = []
    pitch = e.shape[-1] // g
    for row in range(g):
        for column in range(g):
            c_d = e[:, row * pitch + pitch // 2, column * pitch + pitch // 2]
            assert net.head_where.bias is not None
            q_where = normal(net.head_where.weight[:, :, 0, 0] @ c_d + net.head_where.bias)
            cell = torch.tensor([(2 * row + 1) / g - 1, (2 * column + 1) / g - 1], dtype=torch.float64)
            raw_size, raw_centre = q_where[0].chunk(2)
            centre = (cell + net.windows.reach * torch.tanh(raw_centre)).clamp(-1, 1)
            nothing = torch.zeros(model.hidden, dtype=torch.float64)
            hidden = dict.fromkeys(("prior", "where", "what", "pres"), nothing)
            thing = Thing(0, nothing, torch.cat([4 * torch.tanh(raw_size / 4), centre]), False, hidden)

            code = glimpses.glimpse(cut(e, thing.window, glimpses.size)[None])[0]
            what_0 = torch.zeros(model.appearance.what, dtype=torch.float64)
            thing.hidden = hidden | {"what": recur(model.appearance.rnn, nothing, code, what_0)}
            q_what = appearance(model, thing.hidden["what"], code)
            thing.what = q_what[0]
            proposal = torch.sigmoid(net.head_pres(torch.cat([c_d, thing.what, thing.window])))

            alpha = mask_logits(model, thing.what)
            inside = paste(torch.ones_like(alpha)[None], thing.window, size)[0]
            claim = torch.tanh(torch.log(1 + paste(alpha[None], thing.window, size)[0].exp())) * inside
            context = float((scope * claim).sum() / claim.sum())
            q_pres = float(proposal) * context
            p_pres = p0 * float((scope * inside).sum() / inside.sum())
            thing.present = q_pres > 0.5
            told.contexts.append(context)
            told.terms["kl_pres"] += kl_presence(q_pres, p_pres)
            if thing.present:
                one = torch.ones(4, dtype=torch.float64)
                sixth = model.discovery_prior.size
                mean = torch.tensor([math.log(sixth / (1 - sixth))] * 2 + [0.0, 0.0], dtype=torch.float64)
                told.terms["kl_where"] += kl_normal((mean, one), q_where)
                told.terms["kl_what"] += kl_normal((torch.zeros_like(q_what[0]), torch.ones_like(q_what[0])), q_what)
            found.append((q_pres, thing))
    found.sort(key=lambda pair: -pair[0])
    return [thing for _, thing in found[: model.render_top] if thing.present]


@torch.no_grad()
def explain(model: Apex, video: Tensor, p0: float, scales: tuple[float, float]) -> Told:
    """The whole of APEX for a video (T, 3, H, W)."""
    told, size = Told(), model.image_size
    assert isinstance(model.masks, ApexNormalisation)
    assert isinstance(model.likelihood, MixtureLikelihood)
    slots: list[Thing | None] = [None] * model.max_objects
    next_id = 1
    z_before: Tensor | None = None
    for image, e in zip(video, model.encoder(video[None])[0][0], strict=True):
        moved = [propagate(model, e, thing, told) if thing is not None else None for thing in slots]
        old = [thing for thing in moved if thing is not None and thing.present]
        s = torch.zeros(size, size, dtype=torch.float64)
        for thing in old:
            s = s + paste(torch.log(1 + mask_logits(model, thing.what).exp())[None], thing.window, size)[0]
        new = discover(model, e, 1 - torch.tanh(s), p0, told)

        things = [*old, *new]
        alphas = [mask_logits(model, thing.what) for thing in things]
        one = torch.ones((), dtype=torch.float64)
        windows = [thing.window for thing in things]
        masks, m_fg, m_bg = frame_masks(alphas, [one] * len(things), windows, model.masks.c, size)
        means = [
            paste(torch.sigmoid(model.colour_decoder(thing.what[None])[0]), thing.window, size) for thing in things
        ]

        q_background = normal(model.background.encoder(torch.cat([m_bg[None], image])[None])[0])
        z = q_background[0]
        prior = (torch.zeros_like(z), torch.ones_like(z))
        if z_before is not None:
            prior = normal(model.background.transition(z_before))
        backdrops = looks(model, decoded(model, z), image)
        z_before = z

        told.terms["nll"] -= log_likelihood(image, [*masks, m_bg], means, backdrops, model.likelihood, scales)
        told.terms["mask_entropy"] += entropy(masks, m_fg)
        told.terms["kl_background"] += kl_normal(q_background, prior)

        room = model.max_objects - len(old)
        slots = [thing if thing is not None and thing.present else None for thing in moved]
        for thing in new[:room]:
            slots[slots.index(None)] = thing
            thing.identity, next_id = next_id, next_id + 1
        shown = {thing.identity: mask for thing, mask in zip(things, masks, strict=True) if thing.identity > 0}
        told.slots.append([thing.identity if thing is not None else -1 for thing in slots])
        told.masks.append(shown)
        picture = sum((m * mean for m, mean in zip(masks, means, strict=True)), m_bg * backdrops[-1])
        assert isinstance(picture, Tensor)
        told.pictures.append(picture)
    return told
