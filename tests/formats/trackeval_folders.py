"""Reads folders with TrackEval's own data sets; runs in TrackEval's Python and talks in JSON.

Reads from standard input a list of `{"dataset": name, "config": {...}, "tracker": name}` and writes for each the
metrics of every sequence and of all together, under `COMBINED`.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys

import numpy as np
import trackeval


def scores(question: dict) -> dict:
    data = getattr(trackeval.datasets, question["dataset"])({**question["config"], "PRINT_CONFIG": False})
    silent = {"PRINT_CONFIG": False}
    metrics = {
        "HOTA": trackeval.metrics.HOTA(),
        "CLEAR": trackeval.metrics.CLEAR(silent),
        "Identity": trackeval.metrics.Identity(silent),
    }
    if question["dataset"] == "DAVIS":
        metrics = {"JAndF": trackeval.metrics.JAndF()}
    found: dict = {name: {} for name in metrics}
    for sequence in data.seq_list:
        raw = data.get_raw_seq_data(question["tracker"], sequence)
        ready = data.get_preprocessed_seq_data(raw, data.class_list[0])
        for name, metric in metrics.items():
            found[name][sequence] = metric.eval_sequence(ready)
    return {
        name: {
            key: {field: np.asarray(value).tolist() for field, value in result.items()}
            for key, result in {**found[name], "COMBINED": metric.combine_sequences(dict(found[name]))}.items()
        }
        for name, metric in metrics.items()
    }


def main() -> None:
    questions = json.load(sys.stdin)
    with contextlib.redirect_stdout(io.StringIO()):
        answers = [scores(question) for question in questions]
    sys.stdout.write("\n" + json.dumps(answers))


if __name__ == "__main__":
    main()
