"""Simulated worlds: P2D, the arrangement task and its clips, example videos."""

import signal
import sys

if sys.argv[:1] == ["-m"] and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # a command is starting: until it listens itself, Ctrl-C ends it without a traceback of its imports
    signal.signal(signal.SIGINT, signal.SIG_DFL)
