"""A rank other than 0, started by `apex_lab.training.ranks.started`: trains along and writes nothing."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Iterable
from pathlib import Path

import torch

from apex_lab.base import console, faults, interrupts
from apex_lab.base.errors import UserError
from apex_lab.base.interrupts import Interrupted
from apex_lab.config import components, trust
from apex_lab.config.building import build_model
from apex_lab.config.schema import Config
from apex_lab.training.devices import set_matmul_precision
from apex_lab.training.fit import fit
from apex_lab.training.ranks import JOB, Ranks, end_with_parent


def main() -> None:
    """Entry point: `python -m apex_lab.training.worker`, with the environment of a rank."""
    for number in (*interrupts.ALWAYS, *interrupts.IF_FREE):
        signal.signal(number, signal.SIG_IGN)  # rank 0 decides when to stop
    end_with_parent()
    console.setup()
    ranks = Ranks(int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"]))
    try:
        with contextlib.suppress(Interrupted), faults.net(f"rank {ranks.rank}"):  # all ranks stop; rank 0 says so
            train_along(Path(os.environ[JOB]), ranks)
    except UserError as error:
        console.error(str(error))
        sys.exit(1)


def train_along(file: Path, ranks: Ranks, known: Iterable[str] | None = None) -> None:
    """Trains as one of several ranks from what rank 0 has left in a file.

    Args:
        file: the job.
        ranks: which process this is.
        known: names of classes that this process's own command names besides the project's; the file, which lies in a
            run folder, may name no others. None for a file of the process that started this one.

    Raises:
        UserError: the file names another class.
    """
    job = torch.load(file, map_location="cpu", weights_only=True)
    if known is not None:
        trust.check(job["config"], str(file), known)
    config = Config(**job["config"])
    model = build_model(config)
    model.load_state_dict(job["weights"])
    source = components.build(config.data, "data")
    source.open()
    callbacks = [components.build(node, f"callbacks.{name}") for name, node in config.callbacks.items()]
    device = torch.device(job["device"])
    set_matmul_precision(device, config.trainer.matmul_precision)
    fit(config, model, source, device, job["step"], job["training"], ranks, callbacks)


if __name__ == "__main__":
    main()
