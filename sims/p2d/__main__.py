"""`python -m sims.p2d`: generates a P2D folder; `verify`, `card` and `export` work on a finished one."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from recordings import MANIFEST, read_journal, verify
from sims.errors import SimError
from sims.p2d.generate import generate, repair
from sims.p2d.settings import Settings
from sims.p2d.settings_text import SettingsError, settings_from
from sims.p2d.store import KIND, SPLITS, read_manifest
from sims.stopping import stoppable


def main(arguments: list[str] | None = None) -> int:
    """Runs one command; returns the exit code: 0 done, 1 failed or damage, 2 wrong settings, 128 + n: signal n."""
    options = _parser().parse_args(arguments)
    try:
        return stoppable(lambda: options.run(options), "finished trajectories")
    except SettingsError as error:
        print(error, file=sys.stderr)
        return 2
    except SimError as error:
        print(error, file=sys.stderr)
        return 1


def _make(options: argparse.Namespace) -> int:
    root: Path = options.out
    settings = settings_from(options.set, _begun(root))
    manifest = generate(root, settings, workers=options.workers)
    if not options.no_card and not (root / "card" / "README.md").exists():
        _card(argparse.Namespace(dir=root, out=None))
    made = ", ".join(f"{getattr(settings, split)} {split}" for split in SPLITS)
    redrawn = sum(record.notes["redraws"] for record in manifest.records.values())
    print(f"{root}: {made} trajectories, {manifest.layout.total_bytes() / 1e9:.2f} GB, {redrawn} attempts redrawn")
    return 0


def _begun(root: Path) -> Settings | None:
    """Settings of a finished or unfinished folder, so that resuming it does not need them on the command line."""
    if (root / MANIFEST).exists():
        return read_manifest(root).settings
    found = read_journal(root, KIND) if root.is_dir() else None
    return found[0].settings if found else None


def _verify(options: argparse.Namespace) -> int:
    root: Path = options.dir
    if options.repair:
        damage = repair(root, workers=options.workers)
        for line in damage.lines():
            print(line)
        print(f"{root}: {'repaired' if damage else 'no damage found'}")
        return 0
    damage = verify(root, read_manifest(root))
    for line in damage.lines():
        print(line)
    if damage:
        print(f"{root}: damaged: repair it with python -m sims.p2d verify {root} --repair")
        return 1
    print(f"{root}: all checksums match")
    return 0


def _card(options: argparse.Namespace) -> int:
    from sims.p2d.card import write_card

    print(f"data card: {write_card(options.dir, options.out or options.dir / 'card')}")
    return 0


def _export(options: argparse.Namespace) -> int:
    from sims.p2d.export import export

    export(options.dir, options.out, options.format, options.split)
    print(f"{options.out}: written")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m sims.p2d",
        description="Generate the P2D data set, or resume an interrupted generation.",
        epilog="settings (--set): " + ", ".join(f"{k}={v.default!r}" for k, v in Settings.model_fields.items()),
    )
    parser.set_defaults(run=_make)
    parser.add_argument("--out", type=Path, default=Path("data/p2d"), help="output folder (default: data/p2d)")
    parser.add_argument(
        "--set", nargs="+", action="extend", default=[], metavar="key=value", help="settings, see below"
    )
    parser.add_argument("--workers", type=_positive, help="number of processes (default: one per core)")
    parser.add_argument("--no-card", action="store_true", help="do not write the data card at the end")
    commands = parser.add_subparsers(metavar="verify | card | export")

    command = commands.add_parser("verify", help="check the checksums of a finished folder")
    command.set_defaults(run=_verify)
    command.add_argument("dir", type=Path)
    command.add_argument("--repair", action="store_true", help="generate damaged trajectories again")
    command.add_argument("--workers", type=_positive, help="number of processes (default: one per core)")

    command = commands.add_parser("card", help="write the data card: Markdown and images")
    command.set_defaults(run=_card)
    command.add_argument("dir", type=Path)
    command.add_argument("--out", type=Path, help="folder for the page (default: DIR/card)")

    command = commands.add_parser("export", help="write PNGs with COCO-style or MOTChallenge-style ground truth")
    command.set_defaults(run=_export)
    command.add_argument("dir", type=Path)
    command.add_argument("--format", choices=("coco", "mot"), required=True)
    command.add_argument("--out", type=Path, required=True, help="folder to write; must not exist")
    command.add_argument("--split", nargs="+", choices=SPLITS, default=list(SPLITS))
    return parser


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is not at least 1")
    return value


if __name__ == "__main__":
    sys.exit(main())
