"""The exceptions for what the user can fix or wait for."""

from __future__ import annotations


class UserError(Exception):
    """Wrong configuration, missing data, damaged file, wrong checkpoint.

    Its message is one sentence that names the key or file, the value, and what to do. Entry points print it without a
    traceback and exit with a non-zero code.
    """


class Busy(UserError):
    """Another process is working on the same thing; waiting for it is all there is to do."""
