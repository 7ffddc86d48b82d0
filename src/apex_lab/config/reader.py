"""The front of commands that read runs: a few options, and words as after `apex_lab.train`. Imports no PyTorch."""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

from apex_lab.base import console, faults
from apex_lab.base.errors import UserError
from apex_lab.base.validation import sentence
from apex_lab.config.command_line import CONFIG_ERROR
from apex_lab.config.options import at_home


class Reader(argparse.ArgumentParser):
    """The options of a command that reads runs; `words` holds the rest, and `config_dir` a further folder.

    Args:
        name: as in `python -m apex_lab.<name>`.
        about: what it does, and examples.
    """

    def __init__(self, name: str, about: str) -> None:
        super().__init__(
            prog=f"python -m apex_lab.{name}",
            description=about,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        self.add_argument("words", nargs="*", help="as after python -m apex_lab.train, `+sweep=...` included")
        self.add_argument("--config-dir", "-cd", metavar="FOLDER", help="a further folder of configuration files")
        # so that the command that started a sweep can be typed again with another name
        self.add_argument("--multirun", "-m", action="store_true", help="taken without effect: several values are read")

    def asked(self) -> argparse.Namespace:
        """What is on this process's command line; options may stand anywhere, home folders (`~`) are written out."""
        asked = self.parse_intermixed_args(sys.argv[1:])
        asked.words = [at_home(word) for word in asked.words]
        return asked

    def error(self, message: str) -> NoReturn:
        raise UserError(sentence(message))


@contextmanager
def ending(code: int = CONFIG_ERROR) -> Iterator[None]:
    """Inside, an exception ends the process with one sentence on standard error, and so does Ctrl-C.

    Args:
        code: of the process.
    """
    console.setup()
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:  # as while a command starts (`apex_lab`)
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with faults.net():
            yield
    except UserError as error:
        console.error(str(error))
        sys.exit(code)
    except KeyboardInterrupt:
        console.error("Stopped by SIGINT.")
        sys.exit(128 + signal.SIGINT)
