"""Hydra's sweeper for lists of jobs; what it does is in `apex_lab.config.sweeps`.

Hydra looks for plugins in the package `hydra_plugins` alone, and imports all of it whenever any program starts Hydra;
so this module imports nothing of apex_lab. Hydra's way of importing it forbids annotations that are strings.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig


@dataclass
class JobsConf:
    """The keys of `hydra.sweeper`.

    Attributes:
        params: key -> values, swept like words of the command line (for experiment files).
        retry_failed: run jobs again that failed in an earlier start.
        slots: into how many equal parts, for one job each, every machine is divided; null: joblib's n_jobs, and no
            division with other launchers.
    """

    _target_: str = "hydra_plugins.apex_lab.sweeper.JobSweeper"
    params: dict[str, str] | None = None
    retry_failed: bool = False
    slots: int | None = None


ConfigStore.instance().store(group="hydra/sweeper", name="jobs", node=JobsConf, provider="apex_lab")


class JobSweeper(Sweeper):
    """Runs the jobs that the command line was expanded to before Hydra started."""

    def __init__(
        self, params: dict[str, str] | None = None, retry_failed: bool = False, slots: int | None = None
    ) -> None:
        self._retry_failed = retry_failed
        self._task: TaskFunction | None = None
        self._launcher: Launcher | None = None
        self._folder = ""
        self._basic = True

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Takes what Hydra has composed; the launcher is built here, so that a faulty one fails before any work."""
        self._task = task_function
        self._folder = str(config.hydra.sweep.dir)
        Path(self._folder).mkdir(parents=True, exist_ok=True)  # launchers would fail job by job
        self._basic = str(config.hydra.launcher._target_).endswith(".BasicLauncher")
        self._launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> Any:
        """Runs all jobs; failures are collected in the sweep, and none is raised."""
        assert self._launcher is not None
        sweep = self._task.sweep  # type: ignore[union-attr] # both set by apex_lab.config.command_line.launch
        sweep.retry_failed = self._retry_failed
        if self._basic:
            sweep.run(self._launcher.launch)
        else:
            relaying = self._task.origin.relaying  # type: ignore[union-attr]
            sweep.run(self._launcher.launch, lambda: relaying(self._launcher, self._folder))
