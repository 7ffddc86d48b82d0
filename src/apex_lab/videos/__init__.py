"""Videos of any kind, read frame by frame: files, folders of pictures, cameras. Imports no PyTorch."""

from __future__ import annotations

from apex_lab.videos.found import find_videos
from apex_lab.videos.framing import Fit, Framing, framing
from apex_lab.videos.reader import Frame, Source, Video, open_video

__all__ = ["Fit", "Frame", "Framing", "Source", "Video", "find_videos", "framing", "open_video"]
