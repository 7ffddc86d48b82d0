"""`python -m apex_lab.metrics.page > docs/metrics.md`: what every number means, and how it is computed."""

from __future__ import annotations

from apex_lab.metrics.keys import KEYS
from apex_lab.metrics.protocol import PROTOCOL

_HEAD = """# The numbers of an evaluation

Made by `python -m apex_lab.metrics.page > docs/metrics.md` from `apex_lab/metrics/keys.py` and `protocol.py`.

`python -m apex_lab.evaluate checkpoint=...` stores them in `metrics.json` under `splits.<split>.total` and
`splits.<split>.per_video`; `python -m apex_lab.evaluate predictions=...` in `<name>.metrics.json` under `total`,
`per_video` and `per_frame`. What is undefined (a mean over nothing, tracking of a model without identities) is `null`.
`settings` holds the settings of scoring, `hota_alpha` holds HOTA per threshold, and `by_property` shows where the model
fails: mean results of true objects alike in class, size, occlusion or contact. Scores of a model of this repository
come with `foreground_share`, the mean share of pixels that it gives to objects and not to its background.

Sections: [0 Input](#0-input), [1 Segmentation](#1-segmentation), [2 Tracking](#2-tracking), [3 Tables](#3-tables),
[4 Beyond the paper](#4-beyond-the-paper), [5 Ignored pixels](#5-ignored-pixels), [6 Files](#6-files),
[References](#references), [7 Keys](#7-keys).

"""


def page() -> str:
    """The protocol, and a Markdown table of all keys of an evaluation with default settings."""
    lines = [_HEAD + PROTOCOL, "## 7. Keys", "| key | meaning | range | better | given per |", "|---|---|---|---|---|"]
    for name, key in KEYS.items():
        levels = ", ".join("data set" if level == "total" else level for level in key.levels)
        lines.append(f"| `{name}` | {key.meaning} | {key.range} | {key.better or '–'} | {levels} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(page(), end="")
