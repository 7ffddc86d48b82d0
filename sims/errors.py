"""The exception for errors that the user can fix."""

from __future__ import annotations


class SimError(Exception):
    """A missing simulator, model or folder, or settings no scene can satisfy.

    Its message is one sentence that names the key or file, the value, and what to do.
    """
