"""The exception for errors that the user can fix, and the sentence for settings that are none."""

from __future__ import annotations

import difflib

from pydantic import BaseModel, ValidationError

from recordings.errors import RecordingError as SimError
from sims.camera import Camera

__all__ = ["SimError", "wrong_setting"]
"""`SimError`: a missing simulator, model or folder, or settings no scene can satisfy.

One class with the store's errors, so that workers pass both on as sentences. Its message is one sentence that names the
key or file, the value, and what to do.
"""


def wrong_setting(error: ValidationError, settings: type[BaseModel]) -> str:
    """The first error of a failed validation as one sentence with the key, the value and the remedy.

    Args:
        error: what validation has raised.
        settings: what was validated.
    """
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        known = sorted(settings.model_fields)
        if len(first["loc"]) > 1:  # only the camera has settings of its own
            known = [f"camera.{name}" for name in sorted(Camera.model_fields)]
        near = difflib.get_close_matches(key, known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
        return f"unknown setting {key!r}: {hint}"
    message = first["msg"].removeprefix("Value error, ")
    if not key:
        return f"settings do not fit together: {message}"
    return f"setting {key}={first['input']!r} is not possible: {message[0].lower() + message[1:]}"
