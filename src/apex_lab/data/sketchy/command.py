"""The command `python -m apex_lab.data.sketchy`: how to get the data, and their preparation."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from apex_lab.base import console, faults
from apex_lab.base.errors import UserError
from apex_lab.base.interrupts import Interrupted, interruptible
from apex_lab.base.validation import path_argument
from apex_lab.data.sketchy.prepare import EXTRACTED, Request, prepare, repair_recording
from apex_lab.data.sketchy.recording import COMMAND
from apex_lab.data.sketchy.split import SPLITS
from apex_lab.data.sketchy.views import WINDOWS

ABOUT = """\
Prepares the Sketchy data set (Cabi et al. 2019) for `python -m apex_lab.train data=sketchy`: real videos of a robot
arm, without labels. It reads episodes or archives of them, checks every checksum and every image, and cuts the images
of GENESIS-V2: two front cameras, seven windows each. Episodes that are cut off or damaged are named and left out.
The same command resumes what was interrupted."""

DOWNLOAD = f"""\
How to get the data
  They cannot be shipped with this program. The release is a public bucket of Google Cloud Storage; its licence is not
  stated. Download the archives of a subset into one folder, for example by
    curl -O -C - https://storage.googleapis.com/sketchy-data/lift_green__demos-00000-of-00002.tar.bz2
  GENESIS-V2 and APEX use the four archives of the two subsets of demonstrations:
    lift_green__demos-00000-of-00002         stack_green_on_red__demos-00000-of-00002
    lift_green__demos-00001-of-00002         stack_green_on_red__demos-00001-of-00002

  subset                         archives  size, about
  lift_green__demos                     2       14 GB
  stack_green_on_red__demos             2       14 GB
  lift_green__episodes                 70      0.5 TB
  stack_green_on_red__episodes        101      0.7 TB
  pull_cloth_up__episodes             133      0.9 TB
  rgb30__all                          205      1.4 TB
  deform8__all                        233      1.6 TB
  episodes_with_rewards                58      0.4 TB   copies of episodes of the others
  An archive holds 100 episodes, the last one of a subset fewer. Sizes are estimated from the 5 TB that the release
  states for all. Episodes have about 200 timesteps at 10 per second.

What it needs and makes below --root
  {EXTRACTED}/          episodes out of archives, as large as these; can be deleted afterwards
  sketchy_NAME_SIZEpx/       the recording: at 128 pixels 140 MB per episode of 201 timesteps with all windows, 56 GB
                             for 400 episodes; with --windows full 20 MB and 8 GB

Then
  python -m apex_lab.train data=sketchy data.name=NAME scale=paper
  Other scales have other sizes of images: prepare them with --image-size 64 (scale=cpu), 32 (scale=smoke).
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point. Exit codes: 0 done, 1 failed, 2 wrong words, 128 + signal for a request to stop."""
    options = _parser().parse_args(arguments)
    console.setup()
    request = Request(options.folder, options.root, options.name, options.image_size, options.windows, options.workers)
    try:
        with faults.net(), interruptible():
            (_repair if options.repair else _prepare)(request)
    except UserError as error:
        console.error(str(error))
        sys.exit(1)
    except Interrupted as stop:
        console.error(f"Stopped by {stop}; what is finished is kept: run the same command to resume.")
        sys.exit(128 + stop.signum)


def _prepare(request: Request) -> None:
    manifest = prepare(request)
    parts = ", ".join(f"{len(manifest.settings['episodes'][split])} {split}" for split in SPLITS)
    size = manifest.layout.total_bytes() / 1e9
    console.say(f"{request.recording}: {parts} episodes, {size:.2f} GB")


def _repair(request: Request) -> None:
    lines = repair_recording(request)
    for line in lines:
        console.say(line)
    console.say(f"{request.recording}: {'repaired' if lines else 'no damage found'}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=COMMAND,
        description=ABOUT,
        epilog=DOWNLOAD,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "folder", type=path_argument, metavar="FOLDER", help="episodes or .tar.bz2 archives, also in sub-folders"
    )
    parser.add_argument(
        "--root", type=path_argument, default=Path("data"), help="folder of all data sets (default: data)"
    )
    parser.add_argument("--name", type=_name, default="demos", help="of the recording: data.name (default: demos)")
    parser.add_argument(
        "--image-size", type=_size, default=128, metavar="SIZE", help="height and width in pixels (default: 128)"
    )
    parser.add_argument(
        "--windows",
        type=_windows,
        default=tuple(WINDOWS),
        help=f"comma-separated, out of {','.join(WINDOWS)} (default: all)",
    )
    parser.add_argument("--workers", type=_positive, help="number of processes (default: one per core)")
    parser.add_argument(
        "--repair",
        action="store_true",
        help="compare a finished recording with its checksums, make damaged parts again",
    )
    return parser


def _positive(text: str) -> int:
    return _number(text, 1, 10**6)


def _size(text: str) -> int:
    return _number(text, 16, 352)


def _number(text: str, least: int, most: int) -> int:
    if not re.fullmatch(r"[0-9]+", text) or not least <= int(text) <= most:
        raise argparse.ArgumentTypeError(f"{text!r} is no number from {least} to {most}")
    return int(text)


def _name(text: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_-]+", text):
        raise argparse.ArgumentTypeError(f"{text!r} is no name of letters, digits, _ and -")
    return text


def _windows(text: str) -> tuple[str, ...]:
    given = text.split(",")
    for window in given:
        if window not in WINDOWS:
            raise argparse.ArgumentTypeError(f"{window!r} is none of {', '.join(WINDOWS)}")
    return tuple(window for window in WINDOWS if window in given)
