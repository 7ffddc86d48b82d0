"""Chooses values of configuration keys by validation scores, on Optuna.

python -m apex_lab.tune +study=sigma scale=cpu study.trials=24
python -m apex_lab.tune scale=quickstart 'optimizer.lr=tag(log,interval(1e-4,1e-2))' 'clips.batch_size=range(2,9,2)'

The same command again goes on with the study; started twice at once, two workers share it.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

import lightning as L

from apex_lab.base import console, faults
from apex_lab.base.errors import UserError
from apex_lab.config import command_line as cli
from apex_lab.config.job import Job
from apex_lab.train import train
from apex_lab.training import ranks
from apex_lab.tuning.study import Study, check_study, is_of_study
from apex_lab.tuning.tuned_file import refuse_taken
from apex_lab.tuning.workers import tune


def main() -> None:
    """Entry point: `python -m apex_lab.tune`."""
    console.setup()
    try:
        with faults.net():
            if ranks.given() is not None:
                raise UserError("Start this command by itself: each trial is a run in this process, not of torchrun.")
            words, config_dir = cli.take_words(lambda key: not is_of_study(key))
    except UserError as error:
        console.error(str(error))
        sys.exit(cli.CONFIG_ERROR)
    sys.argv[1:] = [f"study.{word}" if word.startswith("unsupervised=") else word for word in sys.argv[1:]]
    checked: list[Study] = []  # checked once, though an entry point asks twice: before it starts and when it does

    def check(raw: dict[str, Any], choices: Mapping[str, str], overrides: Sequence[str]) -> Study:
        if not checked:
            study = check_study(words, config_dir, raw, choices)
            refuse_taken(study)
            checked.append(study)
        return checked[0]

    cli.launch(cli.Command("tune", check, lambda study: tune(study, _train), lambda study: study.name))


def _train(job: Job, callbacks: list[L.Callback], command: str) -> None:
    train(job, callbacks, command)


if __name__ == "__main__":
    main()
