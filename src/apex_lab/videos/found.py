"""Which videos are meant: files, folders, patterns with `*`, cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from apex_lab.base.errors import UserError
from apex_lab.base.files import fitting
from apex_lab.base.order import natural_path_key
from apex_lab.base.validation import to_open
from apex_lab.videos.pictures import SUFFIXES, pictures_in
from apex_lab.videos.reader import Source, camera_number

_SUFFIXES = """
    .mp4 .m4v .mov .qt .avi .mkv .webm .wmv .asf .flv .f4v .mpg .mpeg .m2v .mts .m2ts .ts .3gp .3g2 .ogv .ogg .vob .mxf
    .dv .mjpeg .mjpg .y4m .h264 .264 .hevc .h265 .265 .ivf
"""
VIDEO_SUFFIXES = frozenset(_SUFFIXES.split())
"""Endings of videos in a folder; a file that is named itself may have any."""


def find_videos(patterns: str | Sequence[str]) -> list[Source]:
    """The videos that are meant, each once, in the order of the patterns; those of one pattern in natural order.

    A pattern is a file; a folder of pictures, which is one video; a folder of videos (files, or folders of pictures;
    pictures that lie beside video files are passed over); any of these with `*` or `?`; or a camera's number.

    Nothing is opened: whether a file is a video is found out by `open_video`.

    Raises:
        UserError: a pattern means nothing.
    """
    found: dict[object, Source] = {}
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        if pattern.isdecimal() and not to_open("video", pattern).exists():
            number = camera_number(pattern)
            found.setdefault(number, number)
            continue
        for path in _matches(pattern):
            for video in videos_at(path):
                found.setdefault(video.resolve(), video)
    return list(found.values())


def videos_at(path: Path) -> list[Path]:
    """The file itself; of a folder the videos in it, or the folder itself where it is one of pictures.

    Raises:
        UserError: a folder without videos.
    """
    if not path.is_dir():
        return [path]
    inside = [each for each in path.iterdir() if not each.name.startswith(".")]
    files = [each for each in inside if each.is_file() and each.suffix.lower() in VIDEO_SUFFIXES]
    if not files and pictures_in(path):
        return [path]
    videos = [*files, *(each for each in inside if each.is_dir() and pictures_in(each))]
    if not videos:
        raise UserError(f"{path} is a folder without videos or pictures: give a folder that holds some.")
    return sorted(videos, key=natural_path_key)


def listed(failed: Mapping[Source, str], count: int, done: str) -> str:
    """Why some of the videos failed, a line each.

    Args:
        failed: video -> sentence.
        count: how many videos there are.
        done: what was to be done with them, such as "predicted".
    """
    if count == 1:
        return next(iter(failed.values()))
    reasons = [why if str(source) in why else f"{source}: {why}" for source, why in failed.items()]
    return "\n".join([f"{len(failed)} of {count} videos were not {done}:", *(f"  {why}" for why in reasons)])


def _matches(pattern: str) -> list[Path]:
    path = to_open("video", pattern).expanduser()
    if path.exists():
        return [path]
    if not any(mark in pattern for mark in "*?["):
        raise UserError(f"video = {pattern} does not exist: give a file, a folder, a pattern with * or a camera (0).")
    found = [each for each in fitting("video", path) if _plausible(each)]
    if not found:
        raise UserError(f"video = {pattern} fits nothing: give video files or folders of pictures.")
    return sorted(found, key=natural_path_key)


def _plausible(path: Path) -> bool:
    """Whether something that a pattern fits is meant: hidden files, and folders without videos, are not."""
    if path.name.startswith("."):
        return False
    if path.is_dir():
        return any(each.suffix.lower() in SUFFIXES | VIDEO_SUFFIXES for each in path.iterdir())
    return path.is_file()
