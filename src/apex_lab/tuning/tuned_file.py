"""The best values of a study as a file of the configuration group `tuned`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from optuna.trial import FrozenTrial

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, write_text
from apex_lab.config.composition import CHOICES, conf_dir
from apex_lab.tuning.study import Study

STUDY_LINE = "# Study: "
"""Start of the line by which a file is known to be of a study."""


def write_tuned(study: Study, trial: FrozenTrial) -> list[Path]:
    """Writes conf/tuned/<study>.yaml into the study's folder and, from a checkout, into the repository.

    A file of the repository that another study has written is left as it is.

    Args:
        study: which.
        trial: whose values.

    Returns:
        The files.
    """
    text = tuned_text(study, trial)
    own = study.folder / "conf" / "tuned" / f"{study.word}.yaml"
    found = [own]
    make_folder(own.parent)
    write_text(own, text)
    shared = _shared(study)
    if shared is not None:
        other = _study_of(shared)
        if other in (None, study.name):
            make_folder(shared.parent)
            write_text(shared, text)
            found.append(shared)
        else:
            console.warn(f"{shared} is of the study {other} and stays: remove it to get the values of this one there.")
    for path in found:
        console.say(str(path))
    searched = "" if study.asked.study.conf is None and len(found) > 1 else f" --config-dir {found[-1].parent.parent}"
    console.say(f"use them: python -m apex_lab.train {_choices(study)}+tuned={study.word}{searched}")
    return found


def tuned_text(study: Study, trial: FrozenTrial) -> str:
    """The file: what the study's file fixes, and the best values; plain values alone.

    Raises:
        UserError: a value is no plain one.
    """
    scores = ", ".join(
        f"{name} {value:.6g}" for name, value in zip(study.asked.study.scores, trial.values, strict=True)
    )
    lines = [
        "# @package _global_",
        f"{STUDY_LINE}{study.name}",
        f"# Trial {trial.number} of {study.asked.study.trials}, seeds {list(study.asked.study.seeds)}: {scores} "
        "(validation videos).",
        f"# Of: python -m apex_lab.train {_choices(study)}{' '.join(_further(study))}".rstrip(),
        "# Written by python -m apex_lab.tune; use it with +tuned=" + study.word,
    ]
    groups: list[Any] = []
    values: dict[str, Any] = {}
    words = [*study.own, *(p.word(trial.params[p.key]) for p in study.parameters)]
    for word in words:
        override = OverridesParser.create().parse_override(word)
        value = override.value()
        if override.is_delete() or isinstance(value, Mapping):
            raise UserError(f"{word}: a tuned file holds plain values alone; set them one by one.")
        if "/" in override.key_or_group:
            groups.append({f"override /{override.key_or_group}": value})
        else:
            _set(values, override.key_or_group.split("."), value)
    content: dict[str, Any] = {**({"defaults": [*groups, "_self_"]} if groups else {}), **values}
    return "\n".join(lines) + "\n" + yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


def _set(values: dict[str, Any], path: list[str], value: Any) -> None:
    for part in path[:-1]:
        values = values.setdefault(part, {})
    values[path[-1]] = value


def _further(study: Study) -> list[str]:
    """Fixed words of the command line besides the choices, for the comment."""
    keys = {word: word.lstrip("+~").partition("=")[0] for word in study.words if word not in study.own}
    return [w for w, key in keys.items() if key not in CHOICES and not key.startswith(("paths", "evaluation."))]


def _choices(study: Study) -> str:
    words = study.base.choices
    named = [f"model={words['model']}"]
    named += [f"+ablation={words['ablation']}"] if "ablation" in words else []
    return " ".join([*named, f"data={words['data']}", f"scale={words['scale']}"]) + " "


def _shared(study: Study) -> Path | None:
    """Where the file goes besides the study's folder.

    `study.conf`, else, for a study with a name, the repository's conf/ in a checkout; an installed package is not
    written to.
    """
    if study.asked.study.conf is not None:
        return Path(study.asked.study.conf) / "tuned" / f"{study.word}.yaml"
    folder = conf_dir()
    inside_package = Path(__file__).resolve().parent.parent in folder.parents
    return None if inside_package or not study.named else folder / "tuned" / f"{study.word}.yaml"


def _study_of(path: Path) -> str | None:
    """Which study wrote a file; None where there is none."""
    if not path.is_file():
        return None
    found = [line for line in path.read_text().splitlines() if line.startswith(STUDY_LINE)]
    return found[0].removeprefix(STUDY_LINE).strip() if found else "of someone's hand"
