"""What the loop over time (loop.py) reads, remembers and leaves."""

from __future__ import annotations

from typing import NamedTuple, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from apex_lab.models.apex.objects import Beliefs, Objects, Posterior, Proposals
from apex_lab.scene import ABSENT


class Frame(NamedTuple):
    """What the loop reads of one frame, all of it made before the loop; D cells of discovery.

    look_at, follow_in (B, C, h, w): sources of glimpses and propagation crops.
    what (B, D, Z), place (B, D, 4), prob (B, D), hidden_what (B, D, hidden): proposals, as in `Proposals`.
    alpha (B, D, g, g): their mask logits.
    """

    look_at: Tensor
    follow_in: Tensor
    what: Tensor
    place: Tensor
    prob: Tensor
    hidden_what: Tensor
    alpha: Tensor


def frames_of(look_at: Tensor, follow_in: Tensor, proposals: Proposals, alphas: Tensor) -> list[Frame]:
    """Video -> frames: takes dimension 1 of everything apart, as in `Frame`.

    All at once, because autograd fills a tensor of the size of the whole video for every slice that is taken alone.
    """
    fields = (look_at, follow_in, proposals.what, proposals.place, proposals.prob, proposals.hidden_what, alphas)
    return [Frame(*values) for values in zip(*(x.unbind(1) for x in fields), strict=True)]


class Claims(NamedTuple):
    """What the cells of a frame would cover, each on its own (Eq. 18), in N of its B videos.

    masks (N, D, H, W). rows (N, D, H), columns (N, D, W): as of `Paster.inside`. videos (N,): which; None: all.
    """

    masks: Tensor
    rows: Tensor
    columns: Tensor
    videos: Int[Tensor, " N"] | None = None

    def of_videos(self, values: Float[Tensor, "B ..."]) -> Float[Tensor, "N ..."]:
        """Values of these videos."""
        return values if self.videos is None else values.index_select(0, self.videos)

    def put(self, others: Float[Tensor, "B ..."], values: Float[Tensor, "N ..."]) -> Float[Tensor, "B ..."]:
        """Values of these videos among those of all."""
        return values if self.videos is None else others.index_copy(0, self.videos, values)


class Claimed(NamedTuple):
    """In which frames of which videos claims matter, frame by frame.

    rows (N,): where these frames' proposals lie. videos: of each of the T frames.
    """

    rows: Int[Tensor, " N"]
    videos: list[Int[Tensor, " N_t"]]

    @staticmethod
    def of(where: Bool[Tensor, "B T"], opened: Int[Tensor, " M"] | None) -> Claimed:
        """Claims matter at `where`, which lies within `opened`: the frames (b T + t) with proposals, None for all."""
        b, t = where.shape
        rows = torch.arange(b * t)
        if opened is not None:
            rows = rows.index_copy(0, opened, torch.arange(len(opened)))
        return Claimed(rows.view(b, t).T[where.T], [videos.nonzero().squeeze(1) for videos in where.unbind(1)])

    def frames(self, claims: list[Tensor]) -> list[Claims | None]:
        """Masks, rows and columns (N, ...) -> those of each frame; None where there are none."""
        counts = [len(videos) for videos in self.videos]
        each = zip(*(values.split(counts) for values in claims), self.videos, strict=True)
        return [Claims(*values) if len(values[0]) else None for values in each]


class FollowedMasks(NamedTuple):
    """Masks of the objects that were propagated into a frame.

    what (B, n, Z). alpha (B, n, g, g): mask logits; None: not made yet. slots (B, n): where they are; None: all, in
    order.
    """

    what: Tensor
    alpha: Tensor | None
    slots: Int[Tensor, "B n"] | None


FIRST_ID = 1


class Memory(NamedTuple):
    """What the loop hands from frame to frame.

    objects: contents of the P slots. valid (B, P): the slot holds an object that the next frame may propagate.
    ids (B, P), next_id (B,): as in `slots.Carried`. carried_on (B, 1): the video's objects are propagated.
    """

    objects: Objects
    valid: Bool[Tensor, "B P"]
    ids: Int[Tensor, "B P"]
    next_id: Int[Tensor, " B"]
    carried_on: Bool[Tensor, "B 1"]

    @staticmethod
    def empty(batch: int, slots: int, what: int, hidden: int, like: Tensor) -> Memory:
        """Before the first frame."""
        return Memory(
            Objects.empty(batch, slots, what, hidden, like),
            torch.zeros(batch, slots, dtype=torch.bool, device=like.device),
            torch.full((batch, slots), ABSENT, device=like.device),
            torch.full((batch,), FIRST_ID, device=like.device),
            torch.zeros(batch, 1, dtype=torch.bool, device=like.device),
        )


class State(NamedTuple):
    """`Scene.state`: everything that the next frames of the same videos start from.

    encoder: state of the ConvLSTM. frame (B, 3, H, W): the last frame. memory: of the loop. z_background (B, Z).
    """

    encoder: tuple[Tensor, Tensor]
    frame: Tensor
    memory: Memory
    z_background: Tensor


class Step(NamedTuple):
    """One frame as the loop leaves it, or, stacked along dimension 1, all frames of a video.

    P propagated slots and N rendered discoveries are the R = P + N components that explain the frame.

    what (B, R, Z), place (B, R, 4), alpha (B, R, g, g), presence (B, R): samples; presence is zero where not valid.
    valid (B, R): there is an object, and it is present.
    alive (B, P): the slot came into the frame with an object, whether or not it is still present.
    propagated: beliefs about the P slots; without the prior until all frames are stacked.
    discovery_prob, discovery_prior, discovery_pres (B, D): q, p and sample of the presence of all D cells.
    source (B, P), carried (B, P), ids (B, P): what the slots hold after filtering, as in `slots.Carried`.
    """

    what: Tensor
    place: Tensor
    alpha: Tensor
    presence: Tensor
    valid: Bool[Tensor, "B R"]
    alive: Bool[Tensor, "B P"]
    propagated: Beliefs | Posterior
    discovery_prob: Float[Tensor, "B D"]
    discovery_prior: Float[Tensor, "B D"]
    discovery_pres: Float[Tensor, "B D"]
    source: Int[Tensor, "B P"]
    carried: Bool[Tensor, "B P"]
    ids: Int[Tensor, "B P"]


def stack_steps(steps: list[Step]) -> Step:
    """Frames -> video: every tensor gets a time dimension at position 1."""

    def stacked(values: list[object]) -> object:
        first = values[0]
        if isinstance(first, Tensor):
            return torch.stack(cast(list[Tensor], values), dim=1)
        kind = type(first)
        assert isinstance(first, tuple)
        columns = zip(*cast(list[tuple[object, ...]], values), strict=True)
        return kind(*(stacked(list(column)) for column in columns))

    return cast(Step, stacked(list(steps)))
