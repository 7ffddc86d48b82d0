"""What an evaluation leaves behind: metrics.json, tables per video and per object, and rows for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.files import clear_drafts, make_folder, read_json, set_aside, write_json, write_text
from apex_lab.evaluation.pictures import Chosen
from apex_lab.evaluation.score import Tally
from apex_lab.formats.scored_files import plain
from apex_lab.metrics import by_property
from apex_lab.runs.state import is_whole

COLUMNS = {"ari_fg": "ARI-FG", "msc_fg": "MSC-FG", "ari": "ARI", "msc": "MSC"}
"""The paper's segmentation scores: key -> heading."""

TRACKING_COLUMNS = {
    **{"mota": "MOTA", "motp": "MOTP", "match": "Match", "id_switches": "ID S.", "fps": "FPs"},
    **{"misses": "Miss", "md": "MD", "mt": "MT"},
}
"""The paper's tracking scores, in percent."""


def store(
    folder: Path,
    split: str,
    tally: Tally,
    result: Mapping[str, Any],
    about: Mapping[str, Any],
    chosen: Sequence[Chosen] = (),
    beside: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Writes the scores of a split; what metrics.json holds of other splits stays.

    metrics.json holds under `splits` and the split's name: `videos` and `frames` (how many), `labelled` (whether there
    is a ground truth), `foreground_share` (mean share of pixels given to objects), `objects_present` (mean number per
    frame), `terms` (loss terms, mean over videos), `settings` (what was asked for and how it was scored), `data` (which
    data were scored), `versions`, `seed` and what else `about` holds, `total` and `per_video` (scores under the keys of
    `apex_lab.metrics.KEYS`), `hota_alpha`, `by_property` (where does the model fail: mean results of objects alike in
    class, size, occlusion or contact) and `pictures` (which videos were drawn). `settings` and `versions` also stand at
    the top, of the split written last. An undefined score is null. per_video_<split>.csv and objects_<split>.csv hold a
    row per video and per true object.

    Args:
        folder: where to.
        split: its name.
        tally: scores of all videos.
        result: `tally.evaluator.result()`.
        about: `settings` and further entries of the split.
        chosen: the videos that were drawn.
        beside: further entries at the top of the file.

    Returns:
        What metrics.json holds of the split.
    """
    path = make_folder(folder) / "metrics.json"
    content = _stored(path)
    videos = [
        {
            **row,
            "foreground_share": tally.shares[row["video"]],
            "objects_present": tally.present[row["video"]],
        }
        for row in result["per_video"]
    ]
    scored = plain(
        {
            "videos": result["total"]["videos"],
            "frames": result["total"]["frames"],
            "labelled": len(result["per_video"]) == len(tally.evaluator.records),
            "foreground_share": tally.mean_share(),
            "objects_present": tally.mean_present() if len(tally) else None,
            "terms": tally.mean_terms(),
            **about,
            "versions": result["versions"],
            "total": result["total"],
            "per_video": videos,
            "hota_alpha": result["hota_alpha"],
            "by_property": by_property(result["per_object"]),
            "pictures": [row._asdict() for row in chosen],
        }
    )
    tables = {f"per_video_{split}.csv": pd.DataFrame(videos), f"objects_{split}.csv": result["per_object"]}
    clear_drafts(folder, [*tables, path.name])
    for name, table in tables.items():
        write_text(folder / name, table.to_csv(index=False))
    top = {"settings": scored["settings"], "versions": scored["versions"], **(beside or {})}
    write_json(path, {**content, **top, "splits": {**content.get("splits", {}), split: scored}})
    return scored


def _stored(path: Path) -> dict[str, Any]:
    """What is there already; a damaged file is set aside, so that the work that was just done is not lost."""
    if not path.exists():
        return {}
    try:
        content = read_json(path)
    except UserError:
        content = {"splits": None}
    splits = content.get("splits", {})
    if isinstance(splits, dict) and all(is_whole(scored) for scored in splits.values()):
        return content
    aside = set_aside(path)
    console.warn(f"{path} was damaged and is set aside as {aside.name}: evaluate other splits that it held again.")
    return {"splits": {k: v for k, v in splits.items() if is_whole(v)} if isinstance(splits, dict) else {}}


def unlabelled(tally: Tally) -> dict[str, Any]:
    """What stands in the place of `Evaluator.result()` for videos without ground truth: no score at all."""
    per_video = [{"video": name, "frames": tally.frames[name]} for name in sorted(tally.positions)]
    empty = tally.evaluator.result()
    total = {"videos": len(tally), "frames": sum(tally.frames.values())}
    return {**empty, "total": total, "per_video": per_video, "hota_alpha": None}


def summary(title: str, total: Mapping[str, Any]) -> str:
    """What was scored, and the paper's numbers under their headings; tracking where there is any.

    Args:
        title: what was scored, such as the split.
        total: scores of all videos together; None where one is undefined.
    """
    lines = [f"{title}: {total.get('videos')} videos, {total.get('frames')} frames"]
    if not any(key in total for key in COLUMNS):
        return f"{lines[0]}; unlabelled, so there are no scores"
    for columns, digits in ((COLUMNS, 3), (TRACKING_COLUMNS, 1)):
        values = [total.get(key) for key in columns]
        if columns is COLUMNS or any(value is not None for value in values):
            lines.append("".join(f"{heading:>9}" for heading in columns.values()))
            # adding 0 turns a negative zero into zero
            lines.append(
                "".join(f"{'n/a' if v is None else format(round(v, digits) + 0.0, f'.{digits}f'):>9}" for v in values)
            )
    return "\n".join(lines)
