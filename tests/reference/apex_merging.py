"""What `models.apex` adds to the paper, as the naive twin has it: masks that see pixels, and pieces that become one.

Frame by frame, component by component, pair by pair; what is judged is judged in NumPy. Networks, mask normalisation
and likelihood are the twin's. What differs from `pixels.py`, `merging.py` and `hulls.py` is how things are computed:

- a window cuts out the features and a query weighs them, where the model weighs all pixels and cuts out the result;
- mask logits move by the addition theorem of what squashes them, where the model takes the inverse and squashes again;
- pixels that do not count yet are multiplied by zero, where the model leaves them out;
- a union's gain is the difference of two bounds of the frame, each with the components that are there and no others,
  where the model adds up what changes, over slots of which some are masked;
- every pixel is held against every tangent of a convex hull, where the model has an interval for each row.

With `model.merges` above zero the benchmark's ratio is partly that of these loops.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from operator import itemgetter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import maximum_filter
from scipy.special import rel_entr
from torch import Tensor
from torch.distributions import Normal, kl_divergence

from apex_lab.models.apex.hulls import DIRECTIONS, TOLERANCE
from apex_lab.models.apex.masks import NEARLY, ApexNormalisation, MaskNormalisation, Masks
from apex_lab.models.apex.merging import MARGIN, TOUCHING
from apex_lab.models.apex.objects import Proposals
from apex_lab.models.apex.pixels import PixelEvidence
from apex_lab.models.apex.windows import window_of
from apex_lab.nn.distributions import Gaussian
from apex_lab.scene import Schedule
from tests.reference.grid import grid_crop

if TYPE_CHECKING:
    from apex_lab.models.apex.model import Apex

MOST = 4
"""Pairs of a frame that are judged: those with the longest rims."""


def pixel_features(
    model: Apex, images: Float[Tensor, "F 3 H W"], schedule: Schedule
) -> Float[Tensor, "F E H W"] | None:
    """Features of each pixel that shift mask logits: of the image, and of how it differs from the empty scene.

    None where masks see no pixels.
    """
    if model.pixels is None:
        return None
    seen = [torch.cat([image - 0.5, image - _empty(model, image, schedule)]) for image in images]
    return torch.stack([model.pixels.convs(one[None])[0] for one in seen])


def _empty(model: Apex, image: Float[Tensor, "3 H W"], schedule: Schedule) -> Float[Tensor, "3 H W"]:
    """The learned bias image with the shadows of this image on it; the image itself where there is no bias image."""
    if model.background.bias_image is None:
        return image
    lit = torch.sigmoid(model.background.bias_image.detach())
    darkest = 1 - (1 - model.background.shadow) * schedule.get("shadow", 1.0)
    u = (image * lit).sum(0) / (lit * lit).sum(0)  # of all u b the one nearest to the pixel's colour
    return lit * u.clamp(min=darkest).clamp(max=1.0)


def sharpened(
    model: Apex,
    alpha: Float[Tensor, "N n g g"],
    what: Float[Tensor, "N n Z"],
    place: Float[Tensor, "N n 4"],
    features: Float[Tensor, "N E H W"] | None,
    schedule: Schedule,
) -> Float[Tensor, "N n g g"]:
    """Mask logits of the components of N frames with what the pixels in their windows say."""
    if features is None or model.pixels is None:
        return alpha
    counts = schedule.get("refinement", 1.0)
    frames = []
    for seen, *components in zip(features, alpha, what, place, strict=True):
        shifted = [
            _shifted(model.masks, a, counts * _agreement(model.pixels, seen, w, p, a.shape[-1]))
            for a, w, p in zip(*components, strict=True)
        ]
        frames.append(torch.stack(shifted))
    return torch.stack(frames)


def _agreement(
    pixels: PixelEvidence,
    features: Float[Tensor, "E H W"],
    what: Float[Tensor, " Z"],
    place: Float[Tensor, " 4"],
    size: int,
) -> Float[Tensor, "size size"]:
    """How well the pixels in a window are what a component asks for; no gradient goes to the window."""
    inside = grid_crop(features[None], window_of(place.detach())[None, None], size)[0, 0]
    query = pixels.query.weight @ what + pixels.query.bias
    return torch.einsum("e,eyx->yx", query, inside)


def _shifted(masks: MaskNormalisation, alpha: Float[Tensor, "g g"], shift: Float[Tensor, "g g"]) -> Tensor:
    """f(x + shift), given alpha = f(x), f what squashes mask logits; x is as far from zero as `masks.raw` lets it be.

    tanh(x + y) = (tanh x + tanh y) / (1 + tanh x tanh y), and the odds of sigmoid(x + y) are e^y times those of
    sigmoid(x).
    """
    if isinstance(masks, ApexNormalisation):
        a, t = (alpha / masks.c).clamp(-NEARLY, NEARLY), torch.tanh(shift)
        return masks.c * (a + t) / (1 + a * t)
    p = alpha.clamp(1 - NEARLY, NEARLY)
    return p / (p + (1 - p) * torch.exp(-shift))


def merged(
    model: Apex,
    found: Proposals,
    images: Float[Tensor, "F 3 H W"],
    source: Float[Tensor, "F C h w"],
    features: Float[Tensor, "F E H W"] | None,
    schedule: Schedule,
) -> Proposals:
    """One round: the proposals with the best union of each frame, where one raises the bound, in place of two.

    Args:
        model: the twin, which draws and judges.
        found: (F, D, ...).
        images, source: the frames, and where glimpses are cut from.
        features: of the frames' pixels, where masks see them.
        schedule: as the model is given it.
    """
    q_what = Gaussian(*(x.clone() for x in found.q_what))
    after = Proposals(found.q_where, q_what, *(x.clone() for x in found[2:]))
    for f, unions in enumerate(judged(model, found, images, source, features, schedule)):
        gain, union = max(unions, key=itemgetter(0), default=(0.0, None))
        if union is None or gain <= 0:
            continue
        cell, (mean, std) = union.kept, union.thing.what
        # Drawn with the numbers of the cell that stays: the union's code is another one with the same noise
        noise = ((found.what[f, cell] - found.q_what.mean[f, cell]) / found.q_what.std[f, cell]).detach()
        after.q_what.mean[f, cell], after.q_what.std[f, cell] = mean, std
        after.what[f, cell] = mean + std * noise
        after.place[f, cell] = union.thing.place
        after.hidden_what[f, cell] = union.hidden
        after.prob[f, union.gone] = 0.0
    return after


def judged(
    model: Apex,
    found: Proposals,
    images: Float[Tensor, "F 3 H W"],
    source: Float[Tensor, "F C h w"],
    features: Float[Tensor, "F E H W"] | None,
    schedule: Schedule,
) -> list[list[tuple[float, Union]]]:
    """For each frame, by how many nats the bound rises for each of its pairs with the longest rims, and their unions.

    Arguments are those of `merged`.
    """
    frames = [
        Frame(model, image, source[f], None if features is None else features[f], schedule)
        for f, image in enumerate(images)
    ]
    return [frame.unions(things_of(found, f, model.render_top)) for f, frame in enumerate(frames)]


class Thing(NamedTuple):
    """What is there in a frame: q(z_what) (Z,), its place (4,) and its p_proposal."""

    what: Gaussian
    place: Tensor
    prob: float


class Union(NamedTuple):
    """Two things as one: which cell stays, which goes, what is there then, the appearance RNN's state (hidden,)."""

    kept: int
    gone: int
    thing: Thing
    hidden: Tensor


def things_of(found: Proposals, f: int, most: int) -> dict[int, Thing]:
    """By cell, those of a frame's likeliest proposals that are there."""
    prob = found.prob[f].tolist()
    likeliest = sorted(range(len(prob)), key=lambda cell: -prob[cell])[:most]
    return {
        cell: Thing(Gaussian(*(x[f, cell] for x in found.q_what)), found.place[f, cell], prob[cell])
        for cell in likeliest
        if prob[cell] > 0.5
    }


@dataclass(frozen=True)
class Frame:
    """A frame that is looked at: image (3, H, W), source of glimpses (C, h, w), features of pixels (E, H, W)."""

    model: Apex
    image: Tensor
    source: Tensor
    features: Tensor | None
    schedule: Schedule

    def unions(self, things: dict[int, Thing]) -> list[tuple[float, Union]]:
        """What the pairs with the longest rims would become, and by how many nats the bound rises for each."""
        if len(things) < 2:
            return []
        with torch.no_grad():
            alone = self.masks(list(things.values()))
            posterior = self.model.background.posterior(alone.background, self.image[None])
            backdrop = self.model.background.decode(posterior.mean)  # for the bounds with unions too
            before = self.bound(list(things.values()), backdrop)
        background = _numpy(alone.background[0])
        masks = dict(zip(things, _numpy(alone.objects[0]), strict=True))
        rims = {pair: rim(*(masks[cell] for cell in pair)) for pair in itertools.combinations(masks, 2)}
        judged = [pair for pair in sorted(rims, key=lambda pair: -rims[pair])[:MOST] if rims[pair] > TOUCHING]
        found = []
        for pair in judged:
            kept, gone = sorted(pair, key=lambda cell: -masks[cell].sum())
            union = self.united(kept, gone, things, around(masks[kept] + masks[gone]))
            left = [union.thing if cell == kept else thing for cell, thing in things.items() if cell != gone]
            with torch.no_grad():
                gain = self.bound(left, backdrop) - before
            gain += self.model.piece_price * rims[pair]
            gain -= self.model.hollow_price * gap(masks, background, kept, gone)
            found.append((gain, union))
        return found

    def united(self, kept: int, gone: int, things: dict[int, Thing], place: Float[Tensor, " 4"]) -> Union:
        """Two things as one, read off the window around both as if it were discovered there."""
        model, place = self.model, place.to(self.source)
        code = model.glimpses.look(self.source[None], window_of(place)[None, None])[0]
        nothing = code.new_zeros(1, model.appearance.what), code.new_zeros(1, model.hidden)
        q_what, hidden = model.appearance(code, *nothing)
        return Union(kept, gone, Thing(Gaussian(*(x[0] for x in q_what)), place, things[kept].prob), hidden[0])

    def masks(self, things: list[Thing]) -> Masks:
        """Masks (1, n, H, W) of n things that are there, and of the background."""
        what, place = (torch.stack(x)[None] for x in ([t.what.mean for t in things], [t.place for t in things]))
        features = None if self.features is None else self.features[None]
        alpha = sharpened(self.model, self.model.alpha(what), what, place, features, self.schedule)
        present = torch.ones_like(alpha[..., 0, 0])
        return self.model.masks.compose(alpha, present, present.bool(), self.model.paster(place, alpha.shape[-1]))

    def bound(self, things: list[Thing], backdrop: Float[Tensor, "1 3 H W"]) -> float:
        """What the frame is worth with these things, in nats: its log-likelihood less the KL terms of discovery.

        Those of z_what, and of z_pres beyond what a cell pays that proposes nothing. z_where is left out.
        """
        what, place = torch.stack([t.what.mean for t in things]), torch.stack([t.place for t in things])
        colours = self.model.colours(what)
        means = self.model.paster(place, colours.shape[-1]).each(colours)
        worth = float(
            self.model.log_likelihood(self.image[None], self.masks(things), means[None], backdrop, self.schedule)
        )
        p0 = float(self.schedule["discovery_presence"])
        for thing in things:
            mean, std = thing.what
            worth -= float(kl_divergence(Normal(mean, std), Normal(0.0, 1.0)).sum())
            worth -= kl_presence(thing.prob, p0) - kl_presence(0.0, p0)
        return worth


def kl_presence(q: float, p: float) -> float:
    """KL of two Bernoulli distributions whose probabilities are kept 1e-6 from 0 and 1; nats."""
    (q, not_q), (p, not_p) = np.clip([(q, 1 - q), (p, 1 - p)], 1e-6, 1 - 1e-6)
    return float(rel_entr(q, p) + rel_entr(not_q, not_p))


def rim(a: Float[np.ndarray, "H W"], b: Float[np.ndarray, "H W"]) -> float:
    """Pixels along which two masks meet or overlap: how much of one is within a pixel of the other; the lesser way."""
    return min(float((maximum_filter(x, 3, mode="constant") * y).sum()) for x, y in ((a, b), (b, a)))


def around(mask: Float[np.ndarray, "H W"]) -> Float[Tensor, " 4"]:
    """Place of the window around what is above a half, `MARGIN` times as large; around all where nothing is."""
    size, centre = [], []
    for axis, n in enumerate(mask.shape):
        lines = np.unique(np.argwhere(mask > 0.5)[:, axis])
        low, high = (lines[0], lines[-1] + 1) if len(lines) else (0, n)
        share = min(max(MARGIN * (high - low) / n, 2 / n), 0.95)
        size.append(np.log(share / (1 - share)))
        centre.append((low + high) / n - 1)
    return torch.tensor([*size, *centre], dtype=torch.float64)


def gap(
    masks: dict[int, Float[np.ndarray, "H W"]], background: Float[np.ndarray, "H W"], first: int, second: int
) -> int:
    """Pixels of background in the convex hull of two things, less those in the hull of each by itself.

    A pixel is whose mask is largest there.
    """
    owner = np.stack([background, *masks.values()]).argmax(0)
    own = {cell: owner == 1 + k for k, cell in enumerate(masks)}
    both, a, b = (in_hull(x, owner == 0) for x in (own[first] | own[second], own[first], own[second]))
    return both - a - b


def in_hull(region: Bool[np.ndarray, "H W"], counted: Bool[np.ndarray, "H W"]) -> int:
    """Counted pixels in the convex hull of a region's pixel centres: those that none of its tangents keeps out."""
    if not region.any():
        return 0
    turn = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    normals = np.stack([np.sin(turn), np.cos(turn)])  # (y, x)
    farthest = (np.argwhere(region) @ normals).max(0)
    return int((np.argwhere(counted) @ normals <= farthest + TOLERANCE).all(1).sum())


def _numpy(values: Tensor) -> np.ndarray:
    return values.detach().double().cpu().numpy()
