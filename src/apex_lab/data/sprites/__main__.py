"""`python -m apex_lab.data.sprites verify FOLDER [--repair]`: checks stored sprites, and draws damaged ones again."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from apex_lab.base import console
from apex_lab.base.interrupts import Interrupted, interruptible
from apex_lab.data.sprites.recording import KIND, Drawer
from recordings import RecordingError, read_manifest, repair, verify


def main(arguments: Sequence[str] | None = None) -> int:
    """Returns the exit code: 0 whole or repaired, 1 failed or damage found, 128 + n after signal n."""
    parser = argparse.ArgumentParser(prog="python -m apex_lab.data.sprites", description=__doc__)
    command = parser.add_subparsers(required=True, metavar="verify").add_parser("verify", help="check all bytes")
    command.add_argument("folder", type=Path, help="a folder that `data=sprites data.stored=true` has made")
    command.add_argument("--repair", action="store_true", help="draw damaged videos again")
    command.add_argument("--workers", type=int, help="number of processes (default: one per core)")
    asked = parser.parse_args(arguments)
    console.setup()
    try:
        with interruptible():
            return _verify(asked.folder, asked.repair, asked.workers)
    except RecordingError as error:
        console.error(str(error))
        return 1
    except Interrupted as stop:
        console.error(f"stopped by {stop}; the same command goes on.")
        return 128 + stop.signum


def _verify(folder: Path, mend: bool, workers: int | None) -> int:
    if mend:
        damage = repair(folder, KIND, lambda plan, facts: Drawer(plan.settings), workers=workers)
    else:
        damage = verify(folder, read_manifest(folder, KIND))
    for line in damage.lines():
        console.say(line)
    if not damage:
        console.say(f"{folder}: all checksums match")
    elif mend:
        console.say(f"{folder}: repaired")
    else:
        console.say(f"{folder}: damaged: repair it with {KIND.repair_command.format(root=folder)}")
    return int(bool(damage) and not mend)


if __name__ == "__main__":
    sys.exit(main())
