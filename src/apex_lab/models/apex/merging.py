"""Pieces of one thing that discovery proposes apart become one proposal where that raises the bound. Not in the paper.

Cells propose alone, so a large thing is often proposed in halves by two cells, and no gradient leads from two good
halves to one whole: every step on the way draws worse. The bound itself knows: with the two halves' codes replaced by
one, read off the window around both, it rises where they are one thing and falls where they are two. So it is asked.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from apex_lab.models.apex.hulls import hollow
from apex_lab.models.apex.masks import Masks
from apex_lab.models.apex.objects import Proposals
from apex_lab.models.apex.windows import window_of
from apex_lab.nn.distributions import Gaussian, kl_bernoulli, kl_gaussian, standard_normal
from apex_lab.nn.slots import gather_slots, may_look

if TYPE_CHECKING:
    from apex_lab.models.apex.model import Apex
    from apex_lab.scene import Schedule

TOUCHING = 4.0
"""Pixels along which two masks have to meet to be judged."""

MARGIN = 1.25
"""Size of a window around two masks, of their extent."""


class Pairs(NamedTuple):
    """V pairs of components, each of one of F frames; the first is the larger one.

    frame (V,): of which frame. first, second (V,): which of its n components. valid (V,): they touch.
    rim (V,): pixels along which they meet, and those where they overlap. place (V, 4): the window around both.
    """

    frame: Int[Tensor, " V"]
    first: Int[Tensor, " V"]
    second: Int[Tensor, " V"]
    valid: Bool[Tensor, " V"]
    rim: Float[Tensor, " V"]
    place: Float[Tensor, "V 4"]


class Known(NamedTuple):
    """What of the n likeliest proposals of F frames is needed to judge them.

    top (F, n): their cells. there (F, n): present. what, place, alpha (F, n, ...): codes, places, mask logits.
    cost, stay (F, n): nats of their z_what, and of their z_pres beyond those of an absent one's.
    """

    top: Tensor
    there: Bool[Tensor, "F n"]
    what: Tensor
    place: Tensor
    alpha: Tensor
    cost: Tensor
    stay: Tensor


def touching(masks: Float[Tensor, "F n H W"], there: Bool[Tensor, "F n"], most: int) -> Pairs:
    """The pairs of each frame that share the longest rims; on a CPU only those that touch, elsewhere `most` each."""
    n = masks.shape[1]
    shared = F.max_pool2d(masks, 3, 1, 1).flatten(2) @ masks.flatten(2).transpose(1, 2)
    a, b = torch.triu_indices(n, n, 1, device=masks.device)
    length = torch.minimum(shared, shared.transpose(1, 2))[:, a, b] * (there[:, a] & there[:, b])
    length, which = length.topk(min(most, len(a)), dim=1)
    frame = torch.arange(len(masks), device=masks.device)[:, None].expand_as(which)
    frame, a, b, valid, length = (x.flatten() for x in (frame, a[which], b[which], length > TOUCHING, length))
    if may_look(masks):
        chosen = valid.nonzero().squeeze(1)
        frame, a, b, valid, length = (x.index_select(0, chosen) for x in (frame, a, b, valid, length))
    area = masks.sum((-2, -1))
    larger = area[frame, a] >= area[frame, b]
    first, second = torch.where(larger, a, b), torch.where(larger, b, a)
    return Pairs(frame, first, second, valid, length, around(masks[frame, first] + masks[frame, second]))


def around(mask: Float[Tensor, "V H W"]) -> Float[Tensor, "V 4"]:
    """Place of the window around a mask's pixels, with a margin; arbitrary where it has none."""
    size, centre = [], []
    for line in ((mask > 0.5).any(-1), (mask > 0.5).any(-2)):
        n = line.shape[-1]
        low = line.to(torch.uint8).argmax(-1).to(mask.dtype)
        high = n - line.flip(-1).to(torch.uint8).argmax(-1).to(mask.dtype)
        size.append((MARGIN * (high - low) / n).clamp(2 / n, 0.95))
        centre.append((high + low) / n - 1)
    return torch.cat([torch.logit(torch.stack(size, -1)), torch.stack(centre, -1)], dim=-1)


def gap(masks: Masks, pairs: Pairs) -> Float[Tensor, " V"]:
    """Pixels of background in the convex hull of both, less those in the hull of each by itself (see hulls.py).

    Background in the hulls of both pieces is taken off twice, so the number can be below zero.
    """
    owner, most = torch.zeros_like(masks.background, dtype=torch.int64), masks.background
    for i, mask in enumerate(masks.objects.unbind(1)):  # an argmax over components takes several times as long
        owner, most = torch.where(mask > most, i + 1, owner), torch.maximum(mask, most)
    owner = owner[pairs.frame]
    first, second = (owner == 1 + x[:, None, None] for x in (pairs.first, pairs.second))
    return hollow(first | second, owner == 0) - hollow(first, owner == 0) - hollow(second, owner == 0)


def merged(
    model: Apex,
    found: Proposals,
    images: Float[Tensor, "F 3 H W"],
    source: Float[Tensor, "F C h w"],
    schedule: Schedule,
    evidence: Float[Tensor, "F E H W"] | None = None,
    most: int = 4,
    rounds: int = 1,
) -> Proposals:
    """The proposals of F frames, in each of them at most one pair per round replaced by one object.

    Args:
        model: what draws and judges.
        found: (F, D, ...).
        images, source: the frames, and where glimpses are cut from.
        schedule: as the model is given it.
        evidence: features of the frames' pixels, where masks see them.
        most: pairs of a frame that are judged.
        rounds: how often; a frame without a gain in one has none in the next.
    """
    look = may_look(found.prob)
    frames = ((found.prob > 0.5).sum(1) > 1).nonzero().squeeze(1) if look else None
    for _ in range(rounds):
        if frames is not None and not len(frames):
            break
        found, changed = _round(model, found, Seen(images, source, evidence, frames), schedule, most)
        frames = changed if look else None
    return found


class Seen(NamedTuple):
    """All F frames of a pass, and those of them that a round looks at (None: all)."""

    images: Tensor
    source: Tensor
    evidence: Tensor | None
    frames: Int[Tensor, " N"] | None

    def of(self, values: Tensor) -> Tensor:
        """Values (F, ...) at the frames that are looked at."""
        return values if self.frames is None else values.index_select(0, self.frames)


def _round(
    model: Apex, found: Proposals, seen: Seen, schedule: Schedule, most: int
) -> tuple[Proposals, Int[Tensor, " n"]]:
    """The proposals after a round, and in which frames something changed; where nobody may look, may have."""
    with torch.no_grad():
        evidence = None if seen.evidence is None else seen.of(seen.evidence)
        known = _known(model, _at(found, seen), evidence, schedule)
        alone = _composed(model, known.alpha, known.place, known.there)
        pairs = touching(alone.objects, known.there, most)
    if not len(pairs.frame):
        return found, pairs.frame
    here = pairs.frame  # among the frames that are looked at
    pairs = pairs._replace(frame=here if seen.frames is None else seen.frames[here])
    code = model.glimpses.look(seen.source[pairs.frame], window_of(pairs.place)[:, None]).squeeze(1)
    nothing = code.new_zeros(len(code), model.appearance.what), code.new_zeros(len(code), model.hidden)
    q_what, hidden = model.appearance(code, *nothing)
    with torch.no_grad():
        judged = pairs._replace(frame=here)
        images = seen.of(seen.images)
        if seen.frames is not None:  # the others need no second look
            few, at = here.unique(return_inverse=True)
            judged, images = pairs._replace(frame=at), images.index_select(0, few)
            evidence = None if evidence is None else evidence.index_select(0, few)
            known = Known(*(x.index_select(0, few) for x in known))
            alone = Masks(*(x.index_select(0, few) for x in alone))
        top = known.top[judged.frame]
        gain = _gain(model, images, evidence, schedule, known, alone, judged, q_what)
        chosen = best_of(gain.masked_fill(~pairs.valid, -torch.inf), pairs.frame, len(found.prob))
    changed = pairs.frame if seen.frames is None else pairs.frame[chosen]
    return _replaced(found, top, pairs, chosen, q_what, hidden), changed


def _at(found: Proposals, seen: Seen) -> Proposals:
    """The proposals of the frames that are looked at."""
    q_where, q_what = (Gaussian(*map(seen.of, q)) for q in found[:2])
    return Proposals(q_where, q_what, *map(seen.of, found[2:]))


def best_of(gain: Float[Tensor, " V"], frame: Int[Tensor, " V"], frames: int) -> Bool[Tensor, " V"]:
    """Which pair of each frame gains most; none where no gain is positive, the first one of several alike."""
    best = gain.new_zeros(frames).scatter_reduce(0, frame, gain, "amax")
    alike = (gain > 0) & (gain == best[frame])
    own = torch.arange(len(gain), device=gain.device)
    first = own.new_full((frames,), len(gain)).scatter_reduce(0, frame, own.masked_fill(~alike, len(gain)), "amin")
    return own == first[frame]


def _replaced(
    found: Proposals, top: Tensor, pairs: Pairs, chosen: Bool[Tensor, " V"], q_what: Gaussian, hidden: Tensor
) -> Proposals:
    """The proposals with the chosen pairs' first ones replaced and their second ones gone; top (V, n): their cells."""
    frames, cells = found.prob.shape
    spot, gone = (pairs.frame * cells + top.gather(1, x[:, None]).squeeze(1) for x in (pairs.first, pairs.second))
    noise = ((found.what - found.q_what.mean) / found.q_what.std).detach()  # what each cell's sample was drawn with
    what = q_what.mean + q_what.std * noise.flatten(0, 1)[spot]
    if may_look(found.prob):
        rows = chosen.nonzero().squeeze(1)
        spot, gone = spot[rows], gone[rows]
    else:  # those that are not chosen go to a row of their own, which is dropped
        rows = torch.arange(len(chosen), device=spot.device)
        spot, gone = (torch.where(chosen, x, frames * cells) for x in (spot, gone))

    def put(old: Float[Tensor, "F D C"], new: Float[Tensor, "V C"]) -> Float[Tensor, "F D C"]:
        flat = torch.cat([old.flatten(0, 1), old.new_zeros(1, old.shape[2])])
        return flat.index_copy(0, spot, new[rows].to(old.dtype))[:-1].unflatten(0, (frames, cells))

    left = torch.cat([torch.ones_like(found.prob).flatten(), found.prob.new_zeros(1)])
    left = left.index_fill(0, gone, 0.0)[:-1].view_as(found.prob)
    return Proposals(
        found.q_where,
        Gaussian(put(found.q_what.mean, q_what.mean), put(found.q_what.std, q_what.std)),
        put(found.what, what),
        put(found.place, pairs.place),
        found.prob * left,
        put(found.hidden_what, hidden),
    )


def _known(model: Apex, found: Proposals, evidence: Tensor | None, schedule: Schedule) -> Known:
    most = min(model.render_top, found.prob.shape[1])
    if may_look(found.prob):  # those that are there come first
        most = min(most, int((found.prob > 0.5).sum(1).max()))
    prob, top = found.prob.topk(most, dim=1)
    what, place = gather_slots(found.q_what.mean, top), gather_slots(found.place, top)
    cost = kl_gaussian(found.q_what, standard_normal(found.q_what.mean))
    stay, away = (kl_bernoulli(x, schedule["discovery_presence"]) for x in (prob, torch.zeros_like(prob)))
    return Known(
        top,
        prob > 0.5,
        what,
        place,
        model.sharpened(model.alpha(what), what, place, evidence, schedule),
        gather_slots(cost, top),
        stay - away,
    )


def _composed(model: Apex, alpha: Tensor, place: Tensor, there: Tensor) -> Masks:
    return model.masks.compose(alpha, there.to(alpha.dtype), there, model.paster(place, alpha.shape[-1]))


def _means(model: Apex, what: Float[Tensor, "*batch Z"], place: Float[Tensor, "*batch 4"]) -> Tensor:
    colours = model.colours(what)
    return model.paster(place, colours.shape[-1]).each(colours)


def _gain(
    model: Apex,
    images: Tensor,
    evidence: Tensor | None,
    schedule: Schedule,
    known: Known,
    alone: Masks,
    pairs: Pairs,
    q_what: Gaussian,
) -> Float[Tensor, " V"]:
    """By how much the bound rises for each pair, with the price of a piece; nats. z_where, a few nats, is left out."""
    frame, first, second = pairs.frame, pairs.first, pairs.second
    backdrop = model.background.decode(model.background.posterior(alone.background, images).mean)
    means = _means(model, known.what, known.place)
    before = model.log_likelihood(images, alone, means, backdrop, schedule)

    own = torch.arange(known.there.shape[1], device=frame.device)

    def joint(old: Float[Tensor, "F n ..."], new: Float[Tensor, "V ..."]) -> Float[Tensor, "V n ..."]:
        here = (own == first[:, None]).view(*first.shape, -1, *[1] * (new.dim() - 1))
        return torch.where(here, new[:, None], old[frame])

    left = known.there[frame] & (own != second[:, None])
    union = model.sharpened(
        model.alpha(q_what.mean)[:, None],
        q_what.mean[:, None],
        pairs.place[:, None],
        None if evidence is None else evidence[frame],
        schedule,
    )
    alpha, place = joint(known.alpha, union.squeeze(1)), joint(known.place, pairs.place)
    after = model.log_likelihood(
        images[frame],
        _composed(model, alpha, place, left),
        joint(means, _means(model, q_what.mean, pairs.place)),
        backdrop[frame],
        schedule,
    )
    saved = known.cost[frame, first] + known.cost[frame, second] + known.stay[frame, second]
    saved = saved + model.piece_price * pairs.rim
    if model.hollow_price:
        saved = saved - model.hollow_price * gap(alone, pairs)
    return after - before[frame] + saved - kl_gaussian(q_what, standard_normal(q_what.mean))
