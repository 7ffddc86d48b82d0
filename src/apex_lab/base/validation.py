"""Strict validation of plain values, and the wording of faults: one sentence with key, value and what to do."""

from __future__ import annotations

import argparse
import difflib
import errno
import inspect
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ValidationError

from apex_lab.base.errors import UserError

LONGEST = 300
"""Characters of a value that a sentence shows."""

LARGEST = 2**63
"""Whole numbers lie below it in size: NumPy and PyTorch count with 64 bits."""

LARGEST_FLOAT = (2 - 2**-23) * 2.0**127
"""The largest number in single precision."""


def openable(path: str) -> str:
    """A path that the system can look for; there need not be anything.

    Raises:
        ValueError: empty, too long, or with characters that no path has.
    """
    if not path.strip():
        raise ValueError("it is empty, as an unset variable is: give a path")
    try:
        os.lstat(path)
    except OSError as error:
        if error.errno in (errno.ENAMETOOLONG, errno.EINVAL):
            raise ValueError(f"no path can be so ({error.strerror})") from error
    except ValueError as error:
        raise ValueError(f"no path can be so ({error})") from error
    return path


def to_open(key: str, text: str) -> Path:
    """The path that a key holds.

    Args:
        key: for the message.
        text: its value.

    Raises:
        UserError: no path can be so.
    """
    try:
        return Path(openable(text))
    except ValueError as error:
        raise UserError(f"{key} = {shown(text)} is wrong: {error}.") from error


def path_argument(text: str) -> Path:
    """A path for an option of `argparse`, which tells what is wrong with it.

    Raises:
        ArgumentTypeError: no path can be so.
    """
    try:
        return Path(openable(text))
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


PathText = Annotated[str, AfterValidator(openable)]
"""A path in a configuration: not empty, and possible on this system."""


def one_line(error: BaseException | str) -> str:
    """The message of an exception, on one line and without a full stop."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text.rstrip(".")


def sentence(text: str) -> str:
    """The text on one line, ended by exactly one mark."""
    text = one_line(text)
    return text if text.endswith(("?", "!")) else text + "."


def shown(value: object) -> str:
    """A value as one would write it in a configuration; the middle of a long one is left out."""
    return short(json.dumps(value, ensure_ascii=False, default=str).replace('"', "'"))


def short(text: str, longest: int = LONGEST) -> str:
    """The text; of a long one the middle is left out."""
    return text if len(text) <= longest else f"{text[: longest // 2]} ... {text[-(longest // 2) :]}"


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """`"; did you mean 'x'?"`, or nothing where no known word is close."""
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f"; did you mean '{close[0]}'?" if close else ""


def validate(
    schema: type[BaseModel],
    values: Mapping[str, Any],
    key: str,
    names: Mapping[str, str] | None = None,
    also_known: Iterable[str] = (),
) -> BaseModel:
    """Validates plain values against a pydantic model.

    Validation goes through JSON, where a list stands for a tuple and a string for a path or an enumeration.

    Args:
        schema: of the values.
        values: what came.
        key: where the values stand in the configuration, for the message.
        names: field of `schema` -> its key in the configuration, where they differ.
        also_known: further words to suggest for an unknown key.

    Raises:
        UserError: the first fault in one sentence.
    """
    refuse_large_numbers({(names or {}).get(name, name): value for name, value in values.items()}, key)
    try:
        return schema.model_validate_json(json.dumps(values))
    except ValidationError as error:
        raise UserError(_fault(error, values, key, names or {}, [*_fields(schema), *also_known])) from error


def refuse_large_numbers(value: Any, key: str = "") -> None:
    """Looks for numbers that no array could hold or count, whatever the key means.

    Args:
        value: plain containers.
        key: where they stand in the configuration, for the message.

    Raises:
        UserError: one is there.
    """
    if isinstance(value, Mapping):
        for name, item in value.items():
            refuse_large_numbers(item, f"{key}.{name}" if key else str(name))
    elif isinstance(value, list | tuple):
        for i, item in enumerate(value):
            refuse_large_numbers(item, f"{key}[{i}]")
    elif isinstance(value, int) and not -LARGEST <= value < LARGEST:
        raise UserError(f"{key} = a whole number of {value.bit_length()} bits is wrong: give one of 64 bits at most.")
    elif isinstance(value, float) and LARGEST_FLOAT < abs(value) < float("inf"):
        raise UserError(
            f"{key} = {value:g} is wrong: no number in single precision is above {LARGEST_FLOAT:g} in size."
        )


def _fault(
    error: ValidationError, values: Mapping[str, Any], key: str, names: Mapping[str, str], known: list[str]
) -> str:
    faults = error.errors(include_url=False)
    first = faults[0]
    place = _place(values, first["loc"])
    if first["type"] == "missing":
        place.append(first["loc"][-1])
    words = [str(names.get(str(part), part)) for part in place]
    full = ".".join([key, *words] if key else words)
    if first["type"] == "extra_forbidden":
        return sentence(f"Unknown key {full} = {shown(first['input'])}{did_you_mean('.'.join(words), known)}")
    if first["type"] == "missing":
        return sentence(f"{full} is missing: give it a value")
    # a hint such as `float | Tensor` has a branch that no written value can take
    here = [f for f in faults if f["loc"][: len(place)] == tuple(place) and f["type"] != "needs_python_object"]
    # where a value is of a kind that is allowed, it does not help to name the other kinds
    here = [f for f in here if f["type"] in _OF_ITS_KIND] or here
    told = [f["msg"].removeprefix("Value error, ") for f in here]
    wanted = (
        ", or ".join(dict.fromkeys(text[:1].lower() + text[1:] for text in told))
        or "a component with a _target_ is wanted here"
    )
    if not place:
        return sentence(f"{key}: {wanted}" if key else wanted)
    return sentence(f"{full} = {shown(first['input'])} is wrong: {wanted}")


_OF_ITS_KIND = (
    *("value_error", "too_short", "too_long", "string_too_short", "string_pattern_mismatch", "finite_number"),
    *("greater_than", "greater_than_equal", "less_than", "less_than_equal"),
)
"""Faults of a value whose kind is allowed, in pydantic's words."""


def _place(values: object, location: tuple[int | str, ...]) -> list[int | str]:
    """The keys in an error's location; pydantic also names the branch of a union there."""
    place: list[int | str] = []
    for part in location:
        if isinstance(values, list):
            inside = isinstance(part, int) and part < len(values)
        else:
            inside = isinstance(values, Mapping) and part in values
        if inside:
            place.append(part)
            values = values[part]  # type: ignore[index]
    return place


def _fields(schema: type[BaseModel], prefix: str = "") -> list[str]:
    """Dotted names of all fields of a model and of the models inside it."""
    found = []
    for name, field in schema.model_fields.items():
        found.append(prefix + name)
        if inspect.isclass(field.annotation) and issubclass(field.annotation, BaseModel):
            found += _fields(field.annotation, f"{prefix}{name}.")
    return found
