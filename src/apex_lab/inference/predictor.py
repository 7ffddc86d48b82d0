"""A trained model, ready to be called on batches of videos."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from apex_lab.inference.sizes import as_float, fitted, fitted_back
from apex_lab.nn.noise import VideoNoise, number_of
from apex_lab.scene import Context, Scene, SceneModel, Schedule

Batch = Mapping[str, Any]
"""`video` uint8 (B, T, 3, H, W), `name` list of B; `segmentation` uint8 (B, T, H, W) where labelled."""


class Predictor:
    """A model in evaluation mode.

    Videos are resized to the model's input size, scenes back to the video's size. Noise is a function of the seed and
    the video's name, so a result depends neither on the batch nor on the order of videos.

    Args:
        model: moved to `device`.
        schedule: values the model is called with, on `device`.
        device: where the model runs.
        precision: 32 or "bf16-mixed".
        posterior: scenes come with `SceneModel.posterior` as their masks.
        seed: of the noise of models that sample in evaluation.
        chunk: frames at a time, for models that stream; None: whole videos.
    """

    def __init__(
        self,
        model: SceneModel,
        schedule: Schedule,
        device: torch.device,
        precision: int | str = 32,
        posterior: bool = False,
        seed: int = 0,
        chunk: int | None = None,
    ) -> None:
        self.model, self.posterior = model.to(device), posterior
        self.schedule, self.device, self.precision = schedule, device, precision
        self.seed, self.chunk = seed, chunk if model.streams else None

    @torch.no_grad()
    def __call__(self, batch: Batch, detail: bool = False, full_size: bool = True) -> Scene:
        """The scene of a batch; a model that reads the ground truth gets it.

        Args:
            batch: as a loader gives it.
            detail: fill the costly fields of `Scene`.
            full_size: the scene has the size of the video; False: that of the model's input.
        """
        self.model.eval()
        video = as_float(batch["video"].to(self.device))
        if self.model.needs_labels:
            return self.model.from_labels(
                video, batch["segmentation"].to(self.device).long(), Context(self.schedule, detail=detail)
            )
        chunk = self.chunk or video.shape[1]
        scenes: list[Scene] = []
        for start in range(0, video.shape[1], chunk):
            state = scenes[-1].state if scenes else None
            frames = video[:, start : start + chunk]
            scenes.append(self.chunk_of(frames, batch["name"], start, state, detail, full_size))
        return joined(scenes)

    def chunk_of(
        self,
        video: Tensor,
        names: Sequence[str],
        first_frame: int = 0,
        state: Any = None,
        detail: bool = False,
        full_size: bool = True,
    ) -> Scene:
        """The scene of consecutive frames.

        Args:
            video: (B, T, 3, H, W) RGB in [0, 1].
            names: of the videos.
            first_frame: index of the first of these frames in its video.
            state: `Scene.state` of the frames before.
            detail: fill the costly fields of `Scene`.
            full_size: as of a call.
        """
        noise = VideoNoise(self.seed, [number_of(name) for name in names], first_frame)
        context = Context(self.schedule, noise, state, detail or self.posterior)
        small = fitted(video, self.model.input_size)
        with torch.autocast(video.device.type, dtype=torch.bfloat16, enabled=self.precision == "bf16-mixed"):
            scene = self.model(small, context)
        if self.posterior:
            scene = dataclasses.replace(scene, masks=self.model.posterior(scene, small, context))
        return fitted_back(scene, (video.shape[-2], video.shape[-1])) if full_size else scene


def _averaged(found: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Mean of each value over the chunks that have it."""
    names = dict.fromkeys(name for each in found for name in each)
    return {name: torch.stack([each[name] for each in found if name in each]).mean(0) for name in names}


def _terms(scenes: Sequence[Scene]) -> dict[str, Any]:
    """Loss terms of all chunks' frames, and their weight."""
    weights = [1.0 if scene.terms_weight is None else scene.terms_weight for scene in scenes]
    total = None if scenes[-1].terms_weight is None else sum(weights)
    shares = [weight / (total or 1.0) for weight in weights]
    terms = {
        name: torch.stack([scene.terms[name] * share for scene, share in zip(scenes, shares, strict=True)]).sum(0)
        for name in scenes[-1].terms
    }
    return {"terms": terms, "terms_weight": total}


def joined(scenes: Sequence[Scene]) -> Scene:
    """Scenes of consecutive chunks of the same videos -> the scene of all their frames.

    Loss terms are summed, or averaged by `Scene.terms_weight`; diagnostics, which describe a chunk, are averaged over
    chunks.
    """
    if len(scenes) == 1:
        return scenes[0]
    last = scenes[-1]

    def over_time(name: str) -> Any:
        values = [getattr(scene, name) for scene in scenes]
        return None if values[0] is None else torch.cat(values, dim=1)

    names = ("masks", "ids", "presence", "appearance", "reconstruction", "windows", "means")
    return Scene(
        background=last.background,
        **_terms(scenes),
        diagnostics=_averaged([scene.diagnostics for scene in scenes]),
        state=last.state,
        **{name: over_time(name) for name in names},
    )
