"""TensorBoard: `logger=tensorboard`."""

from __future__ import annotations

import contextlib
import io
import threading
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from PIL import Image

from apex_lab.base.files import unwritable
from apex_lab.runs.folder import Run
from apex_lab.training.loggers import Curves
from apex_lab.training.showing import Interval, Showing, Videos


class TensorBoard(TensorBoardLogger, Showing):
    """Event files in a run's folder; a run that goes on adds to them and repeats nothing.

    Args:
        run: the run that is shown.
        pictures: how many validation videos are drawn during training.
        pictures_every: validations between two pictures.
    """

    NEEDS: ClassVar = ("tensorboard", "tensorboard")  # the package, and the extra of apex_lab that brings it

    def __init__(self, run: Run, pictures: Videos = 2, pictures_every: Interval = 1) -> None:
        vars(rank_zero_only)["rank"] = 0  # only rank 0 has loggers, whatever a variable of Slurm's says
        super().__init__(run.folder.resolve(), name="tensorboard", version="", default_hp_metric=False)
        self.pictures, self.pictures_every = pictures, pictures_every
        self._folder, self._config = run.folder.resolve() / "tensorboard", run.job.raw
        self._points: set[tuple[str, int]] = set()
        self._hook = threading.excepthook

    @property
    def log_dir(self) -> str:
        return str(self._folder)

    def go_on(self, step: int, curves: Curves | None) -> None:
        """Cuts the event files back to a step, and adds what the curves have and they lack."""
        from apex_lab.training import event_files  # imports tensorboard

        self._points = event_files.cut(self._folder, step)
        if any(self._folder.glob(event_files.PATTERN)):
            self._kwargs["purge_step"] = step + 1  # for a TensorBoard that has read further
        threading.excepthook = self._unheard
        with _telling(self._folder):
            for at, values in curves.values() if curves is not None else ():
                self._add(values, at)
            self.experiment.flush()

    def _unheard(self, about: threading.ExceptHookArgs) -> None:
        """The writer's thread hands its errors to whoever writes next; Python need not print them too."""
        if not type(about.thread).__module__.startswith("tensorboard."):
            self._hook(about)

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Adds values at a step; those that are there already stay as they are."""
        with _telling(self._folder):
            self._add(metrics, step or 0)
            self.experiment.flush()

    def _add(self, values: Mapping[str, float], step: int) -> None:
        fresh = {name: value for name, value in values.items() if (name, step) not in self._points}
        super().log_metrics(fresh, step)
        self._points |= {(name, step) for name in fresh}

    def picture(self, name: str, page: Image.Image, step: int) -> None:
        content = io.BytesIO()
        page.save(content, format="PNG")
        self._add_picture(name, content.getvalue(), page.size, step)

    def _add_picture(self, name: str, content: bytes, size: tuple[int, int], step: int) -> None:
        """Adds a PNG or GIF as it is."""
        from tensorboard.compat.proto.summary_pb2 import Summary

        if (name, step) in self._points:
            return
        shown = Summary.Image(width=size[0], height=size[1], colorspace=3, encoded_image_string=content)
        with _telling(self._folder):
            self.experiment._get_file_writer().add_summary(Summary(value=[Summary.Value(tag=name, image=shown)]), step)
            self.experiment.flush()
        self._points.add((name, step))

    def results(self, split: str, scored: Mapping[str, Any], pictures: Sequence[Path], step: int) -> None:
        """Adds the final scores, with the configuration for the tab HPARAMS, and the pictures."""
        total = {f"{split}/{key}": float(v) for key, v in scored["total"].items() if isinstance(v, int | float)}
        if not any(name.startswith("_hparams_/") for name, _ in self._points):
            with _telling(self._folder):
                self.log_hyperparams(self._config, total, step)
                self.experiment.flush()
        for path in pictures:
            if path.suffix in (".png", ".gif"):
                with Image.open(path) as picture:
                    size = picture.size
                self._add_picture(f"{split}/{path.stem}", path.read_bytes(), size, step)

    def log_hyperparams(
        self,
        params: dict[str, Any] | Namespace,
        metrics: dict[str, Any] | None = None,
        step: int | None = None,
    ) -> None:
        """Nothing where Lightning calls it; the configuration is shown beside the final scores."""
        if metrics is not None:
            super().log_hyperparams(params, metrics, step)

    def save(self) -> None:
        """Nothing: what is logged is written at once, and the configuration lies in config.yaml."""

    def finalize(self, status: str) -> None:
        """Nothing: the final scores come later."""

    def close(self, failed: bool = False) -> None:
        """Ends the writer's thread."""
        try:
            if self._experiment is not None:
                with _telling(self._folder):
                    self._experiment.close()
        finally:
            threading.excepthook = self._hook


@contextlib.contextmanager
def _telling(folder: Path) -> Iterator[None]:
    """Inside, an event file that cannot be written is told in one sentence.

    Raises:
        UserError: the sentence.
    """
    try:
        yield
    except OSError as error:
        raise unwritable(folder, error) from error
