"""`python -m apex_lab.data.own_videos verify FOLDER [--repair]`: checks clips, and cuts damaged ones again."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from apex_lab.base import console, faults
from apex_lab.base.errors import UserError
from apex_lab.base.interrupts import Interrupted, interruptible
from apex_lab.base.validation import path_argument
from apex_lab.data.own_videos.maker import KIND, ClipMaker, Settings
from apex_lab.data.own_videos.scan import find, scan
from recordings import Facts, Plan, RecordingError, read_manifest, repair, verify


def main(arguments: Sequence[str] | None = None) -> int:
    """Returns the exit code: 0 whole or repaired, 1 failed or damage found, 128 + n after signal n."""
    parser = argparse.ArgumentParser(prog="python -m apex_lab.data.own_videos", description=__doc__)
    command = parser.add_subparsers(required=True, metavar="verify").add_parser("verify", help="check all bytes")
    command.add_argument("folder", type=path_argument, help="a folder that `data=video` has made")
    command.add_argument("--repair", action="store_true", help="cut damaged clips again")
    command.add_argument("--path", help="where the videos are now, if they have been moved")
    command.add_argument("--workers", type=_positive, help="number of processes (default: one per core)")
    asked = parser.parse_args(arguments)
    console.setup()
    try:
        with faults.net(), interruptible():
            return _work(asked.folder, asked.repair, asked.path, asked.workers)
    except UserError as error:
        console.error(str(error))
        return 1
    except Interrupted as stop:
        console.error(f"stopped by {stop}; the same command goes on.")
        return 128 + stop.signum


def _work(folder: Path, mend: bool, path: str | None, workers: int | None) -> int:
    try:
        return _verify(folder, mend, path, workers)
    except RecordingError as error:
        raise UserError(str(error)) from error


def _verify(folder: Path, mend: bool, path: str | None, workers: int | None) -> int:
    if not mend:
        damage = verify(folder, read_manifest(folder, KIND))
        for line in damage.lines():
            console.say(line)
        command = KIND.repair_command.format(root=folder)
        console.say(f"{folder}: damaged: repair it with {command}" if damage else f"{folder}: all checksums match")
        return int(bool(damage))
    damage = repair(folder, KIND, lambda plan, facts: _maker(plan, facts, folder, path), workers=workers)
    for line in damage.lines():
        console.say(line)
    console.say(f"{folder}: {'repaired' if damage else 'no damage found'}")
    return 0


def _maker(plan: Plan[Settings], facts: Facts, folder: Path, path: str | None) -> ClipMaker:
    """Reads the clips from the videos where they are now, told by their content."""
    place = path or str(facts["source"])
    found = {video.digest: video.path for video in scan(find(place), folder / ".videos.json") if video.digest}
    missing = [video["name"] for video in plan.settings["videos"] if video["digest"] not in found]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise UserError(
            f"{missing[0]}{more} is not at {place}, or has changed: give the place of the videos with --path."
        )
    about = {name: value for name, value in facts.items() if name != "versions"}
    sources = [str(Path(found[video["digest"]]).absolute()) for video in plan.settings["videos"]]
    return ClipMaker(plan.settings, sources, about)


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is not at least 1")
    return value


if __name__ == "__main__":
    sys.exit(main())
