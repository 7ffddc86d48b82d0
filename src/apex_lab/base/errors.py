"""The one exception for errors that the user can fix."""

from __future__ import annotations


class UserError(Exception):
    """Wrong configuration, missing data, damaged file, wrong checkpoint.

    Its message is one sentence that names the key or file, the value, and what to do. Entry points print it without a
    traceback and exit with a non-zero code.
    """
