"""Sketchy: real videos of robot manipulation (Cabi et al. 2019), prepared as for GENESIS-V2.

`python -m apex_lab.data.sketchy` makes a recording from the release's files; `SketchySource` opens it for a run.
docs/sketchy.md describes both. Only `source.py` and `video_set.py` import PyTorch.
"""
