"""The README.md in a recording's folder."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from recordings.layout import FORMAT_VERSION

if TYPE_CHECKING:
    from recordings.manifest import Manifest

README = "README.md"


def readme(manifest: Manifest[Any]) -> str:
    """Markdown: type, shape and meaning of every array, and how to read them."""
    kind, layout = manifest.plan.kind, manifest.plan.layout
    rows = "\n".join(
        f"| `{name}.npy` | {np.dtype(field.dtype).name} | {shape_text(layout.shape(name))} | {field.meaning} |"
        for name, field in layout.fields.items()
    )
    splits = "\n".join(f"| {split} | {count} |" for split, count in layout.counts.items())
    first = next((split for split, count in layout.counts.items() if count), "train")
    return f"""# {kind.name}

{kind.about}

Format {FORMAT_VERSION}, fingerprint {manifest.fingerprint}, content {manifest.content}.
All settings, versions and a checksum per {kind.item} are in `manifest.json`.

| split | {kind.items} (N) |
|---|---|
{splits}

Each split is a folder of plain NumPy arrays, first axis the {kind.item}:

| file | type | shape | meaning |
|---|---|---|---|
{rows}

```python
import numpy as np

np.load("{first}/{next(iter(layout.fields))}.npy", mmap_mode="r")
```
"""


def shape_text(dims: tuple[int, ...]) -> str:
    """(N, ...) with the shape of one item."""
    return f"(N{''.join(f', {dim}' for dim in dims)})"
