"""Where the curves go: curves.csv in every run folder, and Weights & Biases where `logger=wandb` asks for it."""

from __future__ import annotations

import csv
import io
import netrc
import os
import secrets
from argparse import Namespace
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

from lightning.pytorch.loggers import Logger

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.files import unwritable, write_text
from apex_lab.base.validation import one_line
from apex_lab.runs.folder import Run, group_name


class Curves(Logger):
    """curves.csv: one row per logged step, one column per value, empty where a value was not logged at a step.

    Args:
        path: the file; rows that are there already are kept up to `step`.
        step: the step that a run resumes from; later rows belong to work that was lost and will be done again.
    """

    def __init__(self, path: Path, step: int = 0) -> None:
        super().__init__()
        self.path = path
        self.rows: list[dict[str, float | int | str]] = []
        self.columns = ["step"]
        if path.is_file():
            with open(path, newline="") as file:
                reader = csv.DictReader(file)
                self.columns = list(reader.fieldnames or self.columns)
                # a row cut off by a kill has missing fields (None) at its end
                whole = [row for row in reader if None not in row.values() and row["step"].isdigit()]
            self.rows = [dict(row) for row in whole if int(row["step"]) <= step]
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
        if self.rows and int(self.rows[-1]["step"]) == step:
            self.rows[-1].update(metrics)
            self._rewrite()
            return
        self.rows.append({"step": step, **metrics})
        if new:
            self._rewrite()
            return
        try:
            with open(self.path, "a", newline="") as file:
                csv.DictWriter(file, self.columns, restval="").writerow(self.rows[-1])
        except OSError as error:
            raise unwritable(self.path, error) from error

    def log_hyperparams(self, params: dict[str, Any] | Namespace, *args: Any, **kwargs: Any) -> None:
        """Nothing: the configuration lies beside the curves."""

    def _rewrite(self) -> None:
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, self.columns, restval="")
        writer.writeheader()
        writer.writerows(self.rows)
        write_text(self.path, text.getvalue())


TIMEOUT = 30.0
"""Seconds that wandb's server has to answer before a run is logged offline; ten times that for the last upload."""


class Wandb(Logger):
    """Weights & Biases; a network that is away or credentials that are missing never stop a run.

    Args:
        run: the run whose curves are sent; wandb's own files lie in its folder.
        project: wandb project.
        entity: wandb user or team; None is the account's default.
        mode: `auto` is online where credentials exist (WANDB_API_KEY, ~/.netrc), else offline.
    """

    def __init__(
        self, run: Run, project: str, entity: str | None = None, mode: Literal["auto", "online", "offline"] = "auto"
    ) -> None:
        super().__init__()
        self._run = run
        if "wandb_id" not in run.record:
            run.update(wandb_id=secrets.token_hex(4))
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
            "dir": str(self._run.folder),
            "group": group_name(job),
            "name": f"{group_name(job)}_seed_{job.config.seed}",
            "tags": [choices[key] for key in ("model", "ablation", "scale") if key in choices],
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

    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        """Sends values at a step of training."""
        self._wandb.log({**metrics, "step": step})

    def log_hyperparams(self, params: dict[str, Any] | Namespace, *args: Any, **kwargs: Any) -> None:
        """Nothing: the configuration is sent at the start."""

    def finalize(self, status: str) -> None:
        """Ends wandb's run if training failed; else it waits for the scores (`end`)."""
        if status != "success":
            self._wandb.finish(exit_code=1)

    def end(self, scores: dict[str, float]) -> None:
        """Sends the final scores and ends wandb's run."""
        self._wandb.summary.update(scores)
        self._wandb.finish()


def credentials() -> bool:
    """Whether wandb would find a key without asking: in the environment or in the netrc file."""
    if os.environ.get("WANDB_API_KEY") or os.environ.get("WANDB_IDENTITY_TOKEN_FILE"):
        return True
    host = urlsplit(os.environ.get("WANDB_BASE_URL", "https://api.wandb.ai")).hostname or ""
    home = Path.home()
    for path in (os.environ.get("NETRC"), home / ".netrc", home / "_netrc"):
        if path and Path(path).is_file():
            try:
                return netrc.netrc(path).authenticators(host) is not None
            except (netrc.NetrcParseError, OSError) as error:
                console.warn(f"wandb: {path} cannot be read ({one_line(error)}).")
    return False
