"""The exception for errors that the user can fix."""

from __future__ import annotations

from recordings.errors import RecordingError as SimError

__all__ = ["SimError"]
"""`SimError`: a missing simulator, model or folder, or settings no scene can satisfy.

One class with the store's errors, so that workers pass both on as sentences. Its message is one sentence that names the
key or file, the value, and what to do.
"""
