"""Scores videos with TrackEval; runs in an environment of its own and talks in JSON.

Reads a list of videos from standard input, each with `shape` (numbers of true objects and of predictions) and a list
of `frames` with `rows`, `columns` and `iou`, and with `truth` and `prediction`, label maps of the video. Writes HOTA,
IDF1 and J&F of each and of all together.
"""

from __future__ import annotations

import json
import sys

import numpy as np
import trackeval
from pycocotools import mask as coco


def sequence(video: dict) -> dict:
    rows = sorted({row for frame in video["frames"] for row in frame["rows"]})
    columns = sorted({column for frame in video["frames"] for column in frame["columns"]})
    frames = video["frames"]
    return {
        "num_timesteps": len(frames),
        "num_gt_ids": len(rows),
        "num_tracker_ids": len(columns),
        "num_gt_dets": sum(len(frame["rows"]) for frame in frames),
        "num_tracker_dets": sum(len(frame["columns"]) for frame in frames),
        "gt_ids": [np.array([rows.index(row) for row in frame["rows"]], dtype=int) for frame in frames],
        "tracker_ids": [np.array([columns.index(c) for c in frame["columns"]], dtype=int) for frame in frames],
        "similarity_scores": [
            np.array(frame["iou"], dtype=float).reshape(len(frame["rows"]), len(frame["columns"])) for frame in frames
        ],
    }


def mask_sequence(video: dict) -> dict:
    maps = {"gt": np.array(video["truth"]), "tracker": np.array(video["prediction"])}
    labels = {"gt": [i for i in np.unique(maps["gt"]) if i > 0], "tracker": list(np.unique(maps["tracker"]))}
    data = {"num_timesteps": len(maps["gt"])}
    for side, frames in maps.items():
        present = [[i for i, label in enumerate(labels[side]) if (frame == label).any()] for frame in frames]
        data[f"num_{side}_ids"] = len(labels[side])
        data[f"{side}_ids"] = [np.array(ids, dtype=int) for ids in present]
        data[f"{side}_dets"] = [
            [coco.encode(np.asfortranarray(frame == labels[side][i], dtype=np.uint8)) for i in ids]
            for frame, ids in zip(frames, present, strict=True)
        ]
    return data


def main() -> None:
    videos = json.load(sys.stdin)
    hota, identity, jf = trackeval.metrics.HOTA(), trackeval.metrics.Identity({"PRINT_CONFIG": False}), None
    jf = trackeval.metrics.JAndF()
    found = {"hota": {}, "identity": {}, "jf": {}}
    for i, video in enumerate(videos):
        found["hota"][i] = hota.eval_sequence(sequence(video))
        found["identity"][i] = identity.eval_sequence(sequence(video))
        found["jf"][i] = jf.eval_sequence(mask_sequence(video))
    metrics = {"hota": hota, "identity": identity, "jf": jf}
    total = {name: metric.combine_sequences(dict(found[name])) for name, metric in metrics.items()}

    def plain(result: dict) -> dict:
        return {key: np.asarray(value).tolist() for key, value in result.items()}

    answer = {
        name: {"videos": [plain(r) for r in found[name].values()], "total": plain(total[name])} for name in metrics
    }
    sys.stdout.write("\n" + json.dumps(answer))


if __name__ == "__main__":
    main()
