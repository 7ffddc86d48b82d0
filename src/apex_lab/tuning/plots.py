"""Plots of a study: how it went, which key matters, and contours, as PNG and as HTML that needs no network."""

from __future__ import annotations

import importlib.util
import io
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState
from optuna.visualization import matplotlib as images

from apex_lab.base import console
from apex_lab.base.files import make_folder, replacing, write_text
from apex_lab.base.validation import one_line

KINDS = {"history": "optimization_history", "importance": "param_importances", "contour": "contour"}
"""Name of the file -> Optuna's plot."""


def draw(study: optuna.Study, objectives: Sequence[str], folder: Path) -> list[Path]:
    """Draws all plots; one that these trials do not allow (one key has no contour) is left out.

    Args:
        study: with a complete trial.
        objectives: their names.
        folder: of the study; files are <kind>[_<objective>].png and .html in its folder plots/.

    Returns:
        The files.
    """
    plots = make_folder(folder / "plots")
    html = importlib.util.find_spec("plotly") is not None
    if not html:
        console.warn("plots as HTML need plotly: pip install 'apex_lab[tune]'.")
    found = []
    for kind in _possible(study):
        for index, name in enumerate(objectives):
            stem = kind if len(objectives) == 1 else f"{kind}_{name}"
            words: dict[str, Any] = {"target_name": name}
            if len(objectives) > 1:
                words["target"] = _value(index)
            found += list(_both(study, kind, words, plots / stem, html))
    return found


def _value(index: int) -> Callable[[FrozenTrial], float]:
    return lambda trial: float(trial.values[index])


def _possible(study: optuna.Study) -> Iterator[str]:
    """Plots that these trials allow: importances need two trials, a contour two keys, both keys that vary."""
    complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    keys = {key for trial in complete for key in trial.params}
    varied = [key for key in keys if len({trial.params.get(key) for trial in complete}) > 1]
    yield "history"
    if len(complete) > 1 and varied:
        yield "importance"
    if len(complete) > 1 and len(varied) > 1:
        yield "contour"


def _both(study: optuna.Study, kind: str, words: dict[str, Any], stem: Path, html: bool) -> Iterator[Path]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            picture = _picture(getattr(images, f"plot_{KINDS[kind]}")(study, **words), kind)
            page = None
            if html:
                page = getattr(optuna.visualization, f"plot_{KINDS[kind]}")(study, **words)
        except (ValueError, RuntimeError, np.linalg.LinAlgError) as error:  # what the drawn numbers do not allow
            console.warn(f"{stem.name}: not drawn ({one_line(error)}).")
            plt.close("all")
            return
    with replacing(stem.with_suffix(".png")) as file:
        file.write(picture)
    yield stem.with_suffix(".png")
    if page is not None:
        write_text(stem.with_suffix(".html"), page.to_html(include_plotlyjs=True, full_html=True))
        yield stem.with_suffix(".html")


def _picture(drawn: Any, kind: str) -> bytes:
    """What Optuna drew with matplotlib, as the bytes of a PNG file."""
    axes = np.atleast_1d(drawn).ravel()
    figure = axes[0].figure
    figure.set_size_inches(*((8, 6) if kind == "contour" else (9, 5)))
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=120, bbox_inches="tight")
    plt.close(figure)
    return buffer.getvalue()
