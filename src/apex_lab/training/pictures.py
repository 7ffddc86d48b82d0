"""Pictures of a few validation videos while a model trains."""

from __future__ import annotations

import lightning as L
from torch.utils.data import Subset

from apex_lab.inference.predictor import Batch
from apex_lab.scene import Scene
from apex_lab.training.learner import Learner
from apex_lab.training.showing import Showing
from apex_lab.view.film import film_page, spread
from apex_lab.view.item import Item, one_video

NAME = "val/pictures"
"""Under which loggers show them."""


class Pictures(L.Callback):
    """Draws a film strip of the same validation videos again and again, from the scenes that validation makes anyway.

    The model is not asked once more and nothing is drawn from a random generator, so training is what it is without
    pictures. It belongs to rank 0, which draws videos of its own share.

    Args:
        logger: where they are shown.
        interval: steps between two validations.
        max_steps: the last step, whose validation is always drawn.
    """

    def __init__(self, logger: Showing, interval: int, max_steps: int) -> None:
        self._logger, self._interval, self._max_steps = logger, interval, max_steps
        self._wanted: frozenset[int] = frozenset()
        self._items: list[Item] = []

    def setup(self, trainer: L.Trainer, learner: L.LightningModule, stage: str) -> None:
        assert isinstance(learner, Learner)
        learner.onlookers.append(self._look)

    def on_validation_start(self, trainer: L.Trainer, learner: L.LightningModule) -> None:
        assert isinstance(learner, Learner)
        last = learner.step >= self._max_steps or trainer.should_stop
        due = last or learner.step // self._interval % self._logger.pictures_every == 0
        videos = trainer.val_dataloaders.dataset if due else []  # type: ignore[union-attr]
        own = videos.indices if isinstance(videos, Subset) else range(len(videos))
        self._items = []
        self._wanted = frozenset(own[i] for i in spread(len(own), self._logger.pictures) if len(own))

    def _look(self, batch: Batch, scene: Scene) -> None:
        """Takes the wanted videos out of a batch."""
        for b, index in enumerate(batch["index"].tolist()):
            if index in self._wanted:
                truth = batch["segmentation"][b : b + 1].cpu() if "segmentation" in batch else None
                name = batch["name"][b]
                self._items.append(Item(name, batch["video"][b : b + 1].cpu(), one_video(scene, b), 0, truth))

    def on_validation_end(self, trainer: L.Trainer, learner: L.LightningModule) -> None:
        assert isinstance(learner, Learner)
        if self._items:
            self._logger.picture(NAME, film_page(self._items), learner.step)
        self._items = []
