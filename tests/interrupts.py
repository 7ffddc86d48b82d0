"""A shell without job control starts background jobs deaf to Ctrl-C, and what tests start would inherit that."""

from __future__ import annotations

import signal


def hear_ctrl_c() -> None:
    """Takes Ctrl-C again where this process was started without it."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
