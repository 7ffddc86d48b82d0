"""`python -m sims.arrangement_clips`: makes a folder of clips, or checks and repairs one."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from recordings import read_manifest, verify
from sims.arrangement_clips.recording import KIND, make, plan, repair
from sims.errors import SimError
from sims.stopping import stoppable


def main(arguments: list[str] | None = None) -> int:
    """Runs one command; returns the exit code: 0 done, 1 failed or damage, 2 wrong settings, 128 + n: signal n."""
    options = _parser().parse_args(arguments)
    try:
        return stoppable(lambda: options.run(options), "finished clips")
    except SimError as error:
        print(error, file=sys.stderr)
        return 1


def _make(options: argparse.Namespace) -> int:
    try:
        settings = KIND.parse(json.loads(options.settings))
    except ValueError as error:
        print(f"--settings {options.settings}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    make(options.dir, settings, options.workers)
    print(f"{options.dir}: {plan(settings).layout.total_bytes() / 1e9:.2f} GB")
    return 0


def _verify(options: argparse.Namespace) -> int:
    root: Path = options.dir
    damage = repair(root, options.workers) if options.repair else verify(root, read_manifest(root, KIND))
    for line in damage.lines():
        print(line)
    if not damage:
        print(f"{root}: all checksums match")
    elif options.repair:
        print(f"{root}: repaired")
    else:
        print(f"{root}: damaged: repair it with {KIND.repair_command.format(root=root)}")
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m sims.arrangement_clips", description=__doc__)
    commands = parser.add_subparsers(metavar="make | verify", required=True)
    command = commands.add_parser("make", help="make a folder of clips, or resume one")
    command.set_defaults(run=_make)
    command.add_argument("dir", type=Path)
    command.add_argument("--settings", default="{}", help="fields of sims.arrangement_clips.settings.Settings, as JSON")
    command.add_argument("--workers", type=int, help="number of processes (default: one per core)")
    command = commands.add_parser("verify", help="compare all bytes with their checksums")
    command.set_defaults(run=_verify)
    command.add_argument("dir", type=Path)
    command.add_argument("--repair", action="store_true", help="make damaged clips again")
    command.add_argument("--workers", type=int, help="number of processes (default: one per core)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
