"""The exception for errors that the user can fix."""

from __future__ import annotations


class RecordingError(Exception):
    """A folder that cannot be used, a full disk, settings that do not match, or a source that cannot give an item.

    Its message is one sentence that names the key or file, the value, and what to do.
    """
