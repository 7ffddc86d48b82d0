"""Where the curves go: curves.csv in every run folder, and Weights & Biases where `logger=wandb` asks for it.

TensorBoard: `apex_lab.training.tensorboard`.
"""

from __future__ import annotations

import csv
import io
import os
import re
import secrets
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote, unquote

from lightning.pytorch.loggers import Logger
from PIL import Image

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, replacing, set_aside, unwritable, write_text
from apex_lab.base.validation import one_line
from apex_lab.base.wandb_account import credentials
from apex_lab.runs.folder import Run, group_name
from apex_lab.training.showing import Interval, Showing, Videos


class Curves(Logger):
    """curves.csv: one row per logged step, one column per value, empty where a value was not logged at a step.

    A damaged file is set aside as curves.damaged.csv, and its whole rows are taken over.

    Args:
        path: the file; rows that are there already are kept up to `step`.
        step: the step that a run resumes from; later rows belong to work that was lost and will be done again.

    Attributes:
        open_row: step and values of the last row where no later one was logged before the run was resumed. Loggers that
            keep a step's values until the next step may have lost it by a kill.
    """

    def __init__(self, path: Path, step: int = 0) -> None:
        super().__init__()
        self.path = path
        self.rows: list[dict[str, float | int | str]] = []
        self.columns = ["step"]
        self.open_row: tuple[int, dict[str, float]] | None = None
        if path.is_file():
            columns, rows, damaged = _read_curves(path)
            if damaged:
                aside = set_aside(path)
                console.warn(f"{path} is damaged and was set aside as {aside.name}; {len(rows)} rows of it are whole.")
            self.columns = columns
            self.rows = [dict(row) for row in rows if int(row["step"]) <= step]
            if rows and len(self.rows) == len(rows):
                values = {name: float(value) for name, value in rows[-1].items() if value and name != "step"}
                self.open_row = int(rows[-1]["step"]), values
        self._rewrite()

    @property
    def name(self) -> str:
        return "curves"

    @property
    def version(self) -> int:
        return 0

    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        """Adds values at a step; a further call at the same step fills the same row."""
        if step is None:
            raise ValueError("log_metrics needs a step")
        new = [name for name in metrics if name not in self.columns]
        self.columns += new
        # callbacks may log a step that is not the last one any more
        place = next((i for i in range(len(self.rows), 0, -1) if int(self.rows[i - 1]["step"]) <= step), 0)
        if place and int(self.rows[place - 1]["step"]) == step:
            self.rows[place - 1].update(metrics)
            self._rewrite()
            return
        self.rows.insert(place, {"step": step, **metrics})
        if new or place < len(self.rows) - 1:
            self._rewrite()
            return
        try:
            with open(self.path, "a", newline="") as file:
                csv.DictWriter(file, self.columns, restval="").writerow(self.rows[-1])
        except OSError as error:
            raise unwritable(self.path, error) from error

    def values(self) -> Iterator[tuple[int, dict[str, float]]]:
        """Step and values of each row."""
        for row in self.rows:
            yield (
                int(row["step"]),
                {name: float(value) for name, value in row.items() if value != "" and name != "step"},
            )

    def forget(self, step: int, beginning: str) -> None:
        """Takes out the values of a step whose names begin so."""
        kept = [
            {n: v for n, v in row.items() if int(row["step"]) != step or not n.startswith(beginning)}
            for row in self.rows
        ]
        self.rows = [row for row in kept if any(value != "" for name, value in row.items() if name != "step")]
        self._rewrite()

    def log_hyperparams(self, params: dict[str, Any] | Namespace, *args: Any, **kwargs: Any) -> None:
        """Nothing: the configuration lies beside the curves."""

    def _rewrite(self) -> None:
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, self.columns, restval="")
        writer.writeheader()
        writer.writerows(self.rows)
        write_text(self.path, text.getvalue())


def _read_curves(path: Path) -> tuple[list[str], list[dict[str, str]], bool]:
    """Columns, whole rows in the order of their steps, and whether anything but the last row was not whole."""
    try:
        with open(path, newline="", encoding="utf-8", errors="replace") as file:
            reader = csv.DictReader(file)
            columns = list(reader.fieldnames or [])
            if not _is_heading(columns):
                return ["step"], [], path.stat().st_size > 0
            rows = list(reader)
    except (OSError, csv.Error):
        return ["step"], [], True
    whole = [_is_whole(row) for row in rows]
    # a kill may have cut off the last row
    return columns, [row for row, sound in zip(rows, whole, strict=True) if sound], not all(whole[:-1])


def _is_heading(columns: list[str]) -> bool:
    return "step" in columns and len(set(columns)) == len(columns) and all(map(_NAME.fullmatch, columns))


def _is_whole(row: dict[str | None, Any]) -> bool:
    """Whether a row has a number or nothing in each column; `csv` puts None where fields are missing or too many."""
    if None in row or None in row.values() or not re.fullmatch(r"\d{1,18}", row["step"], re.ASCII):
        return False
    try:
        for value in row.values():
            float(value or 0)
    except ValueError:
        return False
    return True


_NAME = re.compile(r"[\w./ -]+", re.ASCII)
"""Names of values, such as train/loss."""

TIMEOUT = 30.0
"""Seconds that wandb's server has to answer before a run is logged offline; ten times that for the last upload."""


KEPT = "last_picture"
"""How names of files begin that hold pictures until the next one, in the run's folder `wandb`."""

FLUSH = 0.2
"""Seconds that values wait in wandb's process before they are in an offline run's file; a kill can cost that much."""


class Wandb(Logger, Showing):
    """Weights & Biases; a network that is away or credentials that are missing never stop a run.

    Args:
        run: the run whose curves are sent; wandb's own files lie in its folder.
        project: wandb project.
        entity: wandb user or team; None is the account's default.
        mode: `auto` is online where credentials exist (WANDB_API_KEY, ~/.netrc), else offline.
        pictures: how many validation videos are drawn during training.
        pictures_every: validations between two pictures.
    """

    def __init__(
        self,
        run: Run,
        project: str,
        entity: str | None = None,
        mode: Literal["auto", "online", "offline"] = "auto",
        pictures: Videos = 2,
        pictures_every: Interval = 1,
    ) -> None:
        super().__init__()
        self._run, self.pictures, self.pictures_every = run, pictures, pictures_every
        self._folder = run.folder / "wandb"
        self._unknown = run.record.get("wandb_id") is None  # to wandb, so that it has none of the curves yet
        if self._unknown:
            run.update(wandb_id=secrets.token_hex(4))
        self._step = 0
        self._wandb = self._start(project, entity, mode)

    @property
    def name(self) -> str:
        return "wandb"

    @property
    def version(self) -> str:
        return str(self._wandb.id)

    def _start(self, project: str, entity: str | None, mode: Any) -> Any:
        import wandb

        if mode == "auto" and "WANDB_MODE" in os.environ:
            mode = os.environ["WANDB_MODE"]
        elif mode == "auto":
            mode = "online" if credentials() else "offline"
            if mode == "offline":
                console.say("wandb: no credentials, logging offline (send it later with `wandb sync`).")
        os.environ.setdefault("WANDB_SILENT", "true")
        job, choices = self._run.job, self._run.job.choices
        words: dict[str, Any] = {
            "project": project,
            "entity": entity,
            "dir": str(self._run.folder.resolve()),  # wandb's own process has a working folder of its own
            "group": group_name(job),
            "name": f"{group_name(job)}_seed_{job.config.seed}",
            "job_type": "train",
            "tags": [choices[key] for key in ("model", "ablation", "experiment", "data", "scale") if key in choices],
            "config": job.raw,
            "id": self._run.record["wandb_id"],
            "resume": "allow",
            "reinit": "finish_previous",
        }
        settings = wandb.Settings(
            init_timeout=TIMEOUT,
            finish_timeout=10 * TIMEOUT,
            finish_timeout_raises=False,
            console="off",
            disable_git=True,
            save_code=False,
            x_transaction_log_flush_interval=FLUSH,
        )
        try:
            started = wandb.init(mode=mode, settings=settings, **words)
        except Exception as error:
            if mode == "offline":
                raise UserError(f"logger.wandb cannot start even offline: {one_line(error)}.") from error
            console.warn(f"wandb: cannot be reached ({one_line(error)}), logging offline.")
            wandb.teardown()
            started = wandb.init(mode="offline", settings=settings, **words)
        started.define_metric("*", step_metric="step")
        return started

    def go_on(self, step: int, curves: Curves | None) -> None:
        """Sends what was logged before wandb knew of the run, or the last row, which it may have lost by a kill."""
        if curves is not None and self._unknown:
            for at, values in curves.values():
                self._log(values, at)
        elif curves is not None and curves.open_row is not None:
            at, values = curves.open_row
            self._log({**values, **self._last_pictures(at)}, at)

    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        """Sends values at a step of training, which is wandb's own step too, so that a resumed run goes on there."""
        self._log(metrics, step or 0)

    def _log(self, values: Mapping[str, Any], step: int) -> None:
        self._step = max(self._step, step)  # wandb takes no step that lies before its last one
        self._wandb.log({**values, "step": self._step}, step=self._step)

    def log_hyperparams(self, params: dict[str, Any] | Namespace, *args: Any, **kwargs: Any) -> None:
        """Nothing: the configuration is sent at the start."""

    def picture(self, name: str, page: Image.Image, step: int) -> None:
        """Sends a picture of a step of training.

        wandb keeps it until the next step, as it keeps values. These stand in curves.csv too; the picture is kept as a
        file, until the next one.
        """
        import wandb

        of_name = f"{KEPT}.{quote(name, safe='')}"
        kept = make_folder(self._folder) / f"{of_name}.{step}.png"
        with replacing(kept) as file:
            page.save(file, "png")
        for earlier in self._folder.glob(f"{of_name}.*.png"):
            if earlier != kept:
                earlier.unlink()
        self._log({name: wandb.Image(page)}, step)

    def _last_pictures(self, step: int) -> dict[str, Any]:
        """The pictures of a step that were kept; a damaged one is left out with a warning."""
        import wandb

        found = {}
        for path in self._folder.glob(f"{KEPT}.*.{step}.png"):
            name = unquote(path.name.removeprefix(f"{KEPT}.").removesuffix(f".{step}.png"))
            try:
                with Image.open(path) as page:
                    page.load()
                    found[name] = wandb.Image(page)
            except Exception as error:  # noqa: BLE001 - Pillow has many kinds for a damaged file
                console.warn(f"wandb: {path} cannot be read ({one_line(error)}); this picture is not sent again.")
        return found

    def results(self, split: str, scored: Mapping[str, Any], pictures: Sequence[Path], step: int) -> None:
        """Sends the final scores as summary, the scores of each video as a table, and the pictures."""
        import wandb

        total = {key: value for key, value in scored["total"].items() if isinstance(value, int | float)}
        self._wandb.summary.update({f"{split}/{key}": value for key, value in total.items()})
        columns = list(dict.fromkeys(key for row in scored["per_video"] for key in row))
        rows: list[Any] = [[row.get(key) for key in columns] for row in scored["per_video"]]
        shown: dict[str, Any] = {f"{split}/per_video": wandb.Table(columns=columns, data=rows)}
        for path in pictures:
            if path.suffix == ".png":
                shown[f"{split}/{path.stem}"] = wandb.Image(str(path))
            elif path.suffix == ".mp4":
                shown[f"{split}/{path.stem}"] = wandb.Video(str(path), format="mp4")
        self._log(shown, step)

    def close(self, failed: bool = False) -> None:
        """Ends wandb's run, which a later one goes on with under its id."""
        try:
            self._wandb.finish(exit_code=int(failed))
        except Exception as error:  # noqa: BLE001 - its process may have got the signal that ends this one
            console.warn(f"wandb: the end could not be sent ({one_line(error)}).")
