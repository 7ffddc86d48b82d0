"""Prepared episodes as a recording: an array per view that holds all timesteps of a split, one episode after the other.

Imports no PyTorch, since worker processes import it.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from pathlib import Path
from typing import Any

import PIL
from PIL import features

from apex_lab.data.sketchy.files import front_images
from apex_lab.data.sketchy.split import SPLITS
from apex_lab.data.sketchy.tfrecord import DamagedFileError, Records
from apex_lab.data.sketchy.views import CAMERAS, View, all_views, cut, decoded
from recordings import Facts, Field, Item, Kind, Layout, Maker, Plan, RecordingError

COMMAND = "python -m apex_lab.data.sketchy"

KIND: Kind[dict[str, Any]] = Kind(
    name="Sketchy",
    make_command=f"{COMMAND} FOLDER",
    repair_command=f"{COMMAND} FOLDER --repair",
    item="timestep",
    items="timesteps",
    about=(
        "Videos of a robot arm by Cabi et al. (2019), prepared as for GENESIS-V2: windows of the two front cameras, 10 "
        "images per second, without labels. The settings in manifest.json list the episodes of each split with their "
        "numbers of timesteps, in the order in which the arrays hold them."
    ),
)


def recording_folder(root: Path, name: str, image_size: int) -> Path:
    """Where the episodes of this name and size lie."""
    return root / f"sketchy_{name}_{image_size}px"


@dataclass(frozen=True)
class Episode:
    """A prepared episode: its file's name and the number of its timesteps."""

    name: str
    timesteps: int


def plan(episodes: Mapping[str, Sequence[Episode]], image_size: int, windows: Sequence[str]) -> Plan[dict[str, Any]]:
    """What a recording of these episodes holds.

    Args:
        episodes: split -> episodes in order.
        image_size: height and width of the images in pixels.
        windows: names out of `views.WINDOWS`.
    """
    views = all_views(windows)
    fields = {
        view.name: Field("|u1", ("H", "W", 3), f"window {view.window} of {CAMERAS[view.camera]}, RGB") for view in views
    }
    counts = {split: sum(episode.timesteps for episode in episodes[split]) for split in SPLITS}
    settings = {
        "image_size": image_size,
        "windows": list(dict.fromkeys(view.window for view in views)),
        "episodes": {split: [[one.name, one.timesteps] for one in episodes[split]] for split in SPLITS},
    }
    return Plan(KIND, settings, Layout(fields, counts, {"H": image_size, "W": image_size}))


def episodes_of(settings: Mapping[str, Any]) -> dict[str, list[Episode]]:
    """Split -> the episodes of a recording with these settings."""
    return {split: [Episode(name, count) for name, count in settings["episodes"][split]] for split in SPLITS}


class Timesteps(Maker):
    """Makes the images of all views at a timestep.

    Args:
        settings: of the plan.
        files: episode's name -> file.
        skipped: episode's name -> why it is left out.
    """

    def __init__(
        self, settings: Mapping[str, Any], files: Mapping[str, Path], skipped: Mapping[str, str] | None = None
    ) -> None:
        self.skipped = dict(skipped or {})
        self.image_size = int(settings["image_size"])
        self.views: list[View] = all_views(settings["windows"])
        self.episodes = episodes_of(settings)
        self.files = {one.name: files[one.name] for several in self.episodes.values() for one in several}
        self.ends = {
            split: list(accumulate(one.timesteps for one in several)) for split, several in self.episodes.items()
        }

    def facts(self) -> Facts:
        """The decoder and the filter that determine pixels."""
        turbo = features.version_feature("libjpeg_turbo")
        jpeg = f"turbo {turbo}" if turbo else str(features.version_codec("jpg"))
        return {
            "versions": {"pillow": PIL.__version__, "libjpeg": jpeg},
            "skipped": self.skipped,
        }

    def make(self, split: str, index: int) -> Item:
        """Images (H, W, 3) by view."""
        number = bisect_right(self.ends[split], index)
        episode = self.episodes[split][number]
        file = self.files[episode.name]
        timestep = index - (self.ends[split][number] - episode.timesteps)
        try:
            images = {camera: decoded(image) for camera, image in _images(file, episode.timesteps, timestep).items()}
        except DamagedFileError as error:
            raise RecordingError(f"{file} has changed since it was checked ({error}): run the command again") from None
        return Item({view.name: cut(images[view.camera], view, self.image_size) for view in self.views})


def _images(file: Path, timesteps: int, timestep: int) -> dict[str, Any]:
    status = file.stat()
    records = _records(file, status.st_size, status.st_mtime_ns)
    if len(records) != timesteps:
        raise DamagedFileError(f"{len(records)} timesteps, not {timesteps}")
    return front_images(records, timestep)


@lru_cache(maxsize=1)
def _records(file: Path, size: int, time: int) -> Records:
    """The episode that is being read, at its size and time; timesteps come in order, so one at a time is open."""
    return Records(file)
