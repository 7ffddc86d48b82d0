"""Settings from and to `key=value` arguments, with error messages of one sentence."""

from __future__ import annotations

import json
import shlex
from typing import Any

from pydantic import ValidationError

from sims.errors import SimError, wrong_setting
from sims.p2d.settings import Settings


class SettingsError(SimError):
    """A wrong key or value on the command line."""


def settings_from(words: list[str], base: Settings | None = None) -> Settings:
    """Settings from `key=value` arguments; a value is JSON if it parses, else text; dots select nested settings.

    Raises:
        SettingsError: an unknown key or an impossible value, in one sentence.
    """
    data: dict[str, Any] = base.model_dump(mode="json") if base is not None else {}
    for word in words:
        key, equals, text = word.partition("=")
        if not equals:
            raise SettingsError(f"--set {word}: expected key=value, for example --set frames=20")
        try:
            value = json.loads(text, parse_constant=_no_number)
        except ValueError:
            value = text
        *parents, name = key.split(".")
        place = data
        for parent in parents:
            place = place.setdefault(parent, {})
            if not isinstance(place, dict):
                raise SettingsError(f"--set {word}: {parent} has no nested settings")
        place[name] = value
    try:
        return Settings.model_validate_json(json.dumps(data))
    except ValidationError as error:
        raise SettingsError(sentence(error)) from None


def _no_number(word: str) -> None:
    raise ValueError(word)  # NaN and Infinity stay text, which no setting accepts


def sentence(error: ValidationError) -> str:
    """The first error of a failed validation as one sentence with the key, the value and the remedy."""
    return wrong_setting(error, Settings)


def command_words(settings: Settings) -> str:
    """The `--set` part of the command that generates data with these settings; empty for the defaults."""
    default = Settings()
    words = [
        f"{name}={json.dumps(value)}"
        for name, value in settings.model_dump(mode="json").items()
        if value != default.model_dump(mode="json")[name]
    ]
    return f"--set {shlex.join(words)}" if words else ""
