"""The best values of a study as a file of the configuration group `tuned`."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from optuna.trial import FrozenTrial

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, write_text
from apex_lab.config.composition import CHOICES, OF_LINE, conf_dir
from apex_lab.tuning.study import Study

STUDY_LINE = "# Study: "
"""Start of the line by which a file is known to be of a study."""


def write_tuned(study: Study, trial: FrozenTrial) -> list[Path]:
    """Writes conf/tuned/<study>.yaml into the study's folder and where `apex_lab.train` looks, and says how to use it.

    Args:
        study: which.
        trial: whose values.

    Returns:
        The files.

    Raises:
        UserError: another file has taken its name since the study began.
    """
    text, folder = tuned_text(study, trial), _searched(study)
    found = list(dict.fromkeys(conf / "tuned" / f"{study.tuned}.yaml" for conf in (study.folder / "conf", folder)))
    for path in found:
        if path is found[-1]:
            refuse_taken(study)
        make_folder(path.parent)
        write_text(path, text)
        console.say(str(path))
    words = [*_choices(study), *_groups(study), f"+tuned={study.tuned}"]
    words += ["--config-dir", str(folder)] if folder != conf_dir() else []
    console.say(f"use them: {shlex.join(['python', '-m', 'apex_lab.train', *words])}")
    if study.config_dir is not None and Path(study.config_dir).resolve() != folder.resolve():
        console.say(f"before, put the files of {study.config_dir} there too: a command takes one --config-dir.")
    return found


def refuse_taken(study: Study) -> None:
    """Refuses a name by which `+tuned=` would find another file than the study's.

    Raises:
        UserError: there is one.
    """
    folder = _searched(study)
    for conf in dict.fromkeys((conf_dir(), folder)):  # in this order they are searched
        path = conf / "tuned" / f"{study.tuned}.yaml"
        other = _study_of(path)
        if other is not None and (other != study.name or conf != folder):
            raise UserError(
                f"{path} is there already, and +tuned={study.tuned} would take it in place of what this study finds: "
                "choose another study.name."
            )


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
        f"{OF_LINE}{' '.join([*_choices(study), *_further(study)])}",
        "# Written by python -m apex_lab.tune; use it with +tuned=" + study.tuned,
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


def _groups(study: Study) -> list[str]:
    """Those of them that choose parts of the model, without which the values may have no keys to go to."""
    return [word for word in _further(study) if "/" in word.partition("=")[0]]


def _choices(study: Study) -> list[str]:
    """The words that choose what was tuned."""
    words = study.base.choices
    plus = {"ablation": "+", "experiment": "+"}
    groups = ("model", "ablation", "data", "scale", "experiment")
    return [f"{plus.get(group, '')}{group}={words[group]}" for group in groups if group in words]


def _searched(study: Study) -> Path:
    """The folder of configurations in which `+tuned=` finds the file.

    `study.conf`, else the folder given as `--config-dir`, where the trials' own files lie; else the repository's conf/
    for a study with a name, in a checkout. An installed package is not written to: then it is in the study's folder.
    """
    given = study.asked.study.conf or study.config_dir
    if given is not None:
        return Path(given).resolve()
    folder = conf_dir()
    inside_package = Path(__file__).resolve().parent.parent in folder.parents
    return study.folder / "conf" if inside_package or not study.named else folder


def _study_of(path: Path) -> str | None:
    """Which study wrote a file; None where there is none."""
    if not path.is_file():
        return None
    found = [line for line in path.read_text().splitlines() if line.startswith(STUDY_LINE)]
    return found[0].removeprefix(STUDY_LINE).strip() if found else "of someone's hand"
