"""Adjusted Rand index and segmentation covering as the paper's tables have them (metrics.md section 1).

Every value is computed in float64 from integer counts. Neither metric depends on the values of labels.

* `ari`, `ari_fg`: Hubert and Arabie (1985); ARI-FG looks at the pixels of true objects alone, so a segment that
  bleeds into the background is not punished.
* `covering`: Arbelaez et al. (2011); for each true region the best IoU of any predicted segment. Unscaled (MSC) each
  region has one vote, scaled (SC) it is weighted by its area. Without the background (MSC-FG, SC-FG) only objects
  are to be covered, yet bleeding into the background is punished by the union.

Time (metrics.md section 1.3): `frame` scores each frame alone (the published tables), `sequence` takes all pixels of
a video as one point set with identities as predicted labels (video ARI of SAVi and later work), `frame_then_video` is
the mean of a video's frames.

Frames without any object (both foreground metrics): ARI-FG 1 and covering 0 as in the public code, or left out with
`skip_empty` (NaN marks what is left out).
"""

from __future__ import annotations

from functools import reduce
from typing import Literal, get_args

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from apex_lab.metrics.contingency import Contingency, Labels, contingency

Mode = Literal["frame", "sequence", "frame_then_video"]


def ari(
    prediction: Labels,
    truth: Labels,
    *,
    foreground: bool = False,
    mode: Mode = "frame",
    skip_empty: bool = False,
    ignore_label: int | None = None,
) -> Float64[Tensor, "..."]:
    """Adjusted Rand index, at most 1, 0 for chance.

    Args:
        prediction: identity of the winning component at every pixel, >= 0.
        truth: true labels, >= 0, 0 is the background.
        foreground: only pixels of objects (ARI-FG); without any such pixel the value is 1.
        mode: see the module.
        skip_empty: foreground only: NaN where no object is visible.
        ignore_label: pixels of this true label are left out.

    Returns:
        (B, T) in mode `frame`, (B,) otherwise; NaN where every pixel is left out.

    Raises:
        ValueError, TypeError: see `contingency`.
    """
    return video_scores(contingency(prediction, truth, ignore_label), ari_name(foreground), mode, skip_empty)


def ari_fg(
    prediction: Labels,
    truth: Labels,
    *,
    mode: Mode = "frame",
    skip_empty: bool = False,
    ignore_label: int | None = None,
) -> Float64[Tensor, "..."]:
    """`ari` on the pixels of objects."""
    return ari(prediction, truth, foreground=True, mode=mode, skip_empty=skip_empty, ignore_label=ignore_label)


def covering(
    prediction: Labels,
    truth: Labels,
    *,
    background: bool = True,
    scaled: bool = False,
    mode: Mode = "frame",
    skip_empty: bool = False,
    ignore_label: int | None = None,
) -> Float64[Tensor, "..."]:
    """Segmentation covering in [0, 1].

    Args:
        prediction: identity of the winning component at every pixel, >= 0.
        truth: true labels, >= 0, 0 is the background.
        background: the background is one of the regions to cover; without it and without any object the value is 0.
        scaled: regions weighted by area (SC) and not one vote each (MSC, the paper's).
        mode: see the module.
        skip_empty: without background only: NaN where no object is visible.
        ignore_label: pixels of this true label are left out.

    Returns:
        (B, T) in mode `frame`, (B,) otherwise; NaN where every pixel is left out.

    Raises:
        ValueError, TypeError: see `contingency`.
    """
    table = contingency(prediction, truth, ignore_label)
    return video_scores(table, covering_name(background, scaled), mode, skip_empty)


SCORES = ("ari", "ari_fg", "msc", "msc_fg", "sc", "sc_fg")
"""What `video_scores` can compute."""


def video_scores(
    table: Contingency, name: str, mode: Mode = "frame", skip_empty: bool = False
) -> Float64[Tensor, "..."]:
    """One of `SCORES` for every frame or video of a table; arguments and result as in `ari` and `covering`."""
    if name not in SCORES:
        raise ValueError(f"there is no segmentation score {name!r}; choose one of {', '.join(SCORES)}")
    if mode not in get_args(Mode):
        raise ValueError(f"mode is {mode!r}; choose one of {', '.join(get_args(Mode))}")
    counts = table.counts.sum(dim=1, keepdim=True) if mode == "sequence" else table.counts
    empty = table.empty_frames.all(dim=1, keepdim=True) if mode == "sequence" else table.empty_frames
    foreground = name.endswith("_fg")
    if name.startswith("ari"):
        values = rand_index(counts[:, :, 1:] if foreground else counts)
    else:
        values = best_overlap(counts, background=not foreground, scaled=name.startswith("sc"))
    if foreground and skip_empty:
        values = values.masked_fill(empty, torch.nan)
    # Where every pixel is ignored there is nothing to score.
    values = values.masked_fill(counts.sum(dim=(2, 3)) == 0, torch.nan)
    if mode == "frame":
        return values
    return values.squeeze(1) if mode == "sequence" else values.nanmean(dim=1)


def rand_index(counts: Int64[Tensor, "*S G P"]) -> Float64[Tensor, "*S"]:
    """Adjusted Rand index of contingency tables, with the degenerate cases of metrics.md section 1.1.

    Both partitions the same and trivial (no point, one cluster each, every point its own cluster): 1. One partition
    trivial, the other not: 0.
    """
    together = _pairs(counts).sum(dim=(-2, -1))
    true = _pairs(counts.sum(dim=-1)).sum(dim=-1)
    predicted = _pairs(counts.sum(dim=-2)).sum(dim=-1)
    every = _pairs(counts.sum(dim=(-2, -1)))
    # Decided on integers: the formula is 0/0 or subject to rounding there.
    true_trivial = (true == 0) | (true == every)
    predicted_trivial = (predicted == 0) | (predicted == every)
    expected = true.double() * predicted.double() / every.clamp(min=1).double()
    largest = (true.double() + predicted.double()) / 2
    trivial = true_trivial | predicted_trivial
    value = (together.double() - expected) / torch.where(trivial, 1.0, largest - expected)
    return torch.where(trivial, (true == predicted).double(), value)


def best_overlap(
    counts: Int64[Tensor, "*S G P"], *, background: bool = True, scaled: bool = False
) -> Float64[Tensor, "*S"]:
    """Segmentation covering of contingency tables; 0 where there is no region to cover."""
    area = counts.sum(dim=-1)
    weight = area if scaled else (area > 0).long()
    if not background:
        weight = torch.cat([torch.zeros_like(weight[..., :1]), weight[..., 1:]], dim=-1)
    best = intersection_over_union(counts).amax(dim=-1)
    # Added from left to right, so rows that only pad a batch cannot change the last digit.
    total = reduce(torch.add, (best * weight).unbind(dim=-1))
    return total / weight.sum(dim=-1).clamp(min=1)


def intersection_over_union(counts: Int64[Tensor, "*S G P"]) -> Float64[Tensor, "*S G P"]:
    """IoU of every true region with every predicted segment; 0 where both have no pixel."""
    union = counts.sum(dim=-1, keepdim=True) + counts.sum(dim=-2, keepdim=True) - counts
    return counts.double() / union.clamp(min=1).double()


def _pairs(n: Int64[Tensor, "*S"]) -> Int64[Tensor, "*S"]:
    """How many pairs n points make. 64 bits hold this for up to 4e9 points (a whole video has about 3e5)."""
    return n * (n - 1) // 2


def ari_name(foreground: bool) -> str:
    return "ari_fg" if foreground else "ari"


def covering_name(background: bool, scaled: bool) -> str:
    return ("sc" if scaled else "msc") + ("" if background else "_fg")
