"""Recordings: folders of memory-mappable arrays, made by several processes at once, and never half finished.

```
<root>/manifest.json        written last, atomically: a folder without it is unfinished
<root>/<items>.jsonl        first line: settings and facts; then one line with a checksum per finished item
<root>/<split>/<field>.npy  one array per field of the layout, first axis the item
<root>/README.md            type, shape and meaning of every array
```

Every array has its final size from the start and items are written in place, so several processes can write at once.
An item counts as finished only when its line is in the journal. Resuming first checks all lines against the arrays:
after a kill or a power cut, items that do not match their checksum are made again. Hence nothing needs to be synced to
the disk before the end.

A `Kind` names a family of recordings, a `Plan` (kind, settings, layout) one of them, a `Maker` makes its items.
`record` makes a folder or resumes it, `check` and `verify` compare it with its manifest, `repair` makes damaged items
again, `Reader` opens it. NumPy alone can read the arrays. This package knows neither PyTorch nor the simulator.
"""

from recordings.errors import RecordingError
from recordings.layout import Field, Key, Layout, array_path
from recordings.manifest import MANIFEST, Manifest, Record, read_journal, read_manifest
from recordings.plan import Facts, Item, Kind, Maker, Plan
from recordings.reader import Reader
from recordings.record import cores, record, repair
from recordings.verify import Damage, check, is_verified, verify

__all__ = [
    "MANIFEST",
    "Damage",
    "Facts",
    "Field",
    "Item",
    "Key",
    "Kind",
    "Layout",
    "Maker",
    "Manifest",
    "Plan",
    "Reader",
    "Record",
    "RecordingError",
    "array_path",
    "check",
    "cores",
    "is_verified",
    "read_journal",
    "read_manifest",
    "record",
    "repair",
    "verify",
]
