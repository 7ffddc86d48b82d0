"""Classical methods and tests of the evaluation, as models without learning by gradient."""

from __future__ import annotations

from apex_lab.models.yardsticks.background_subtraction import BackgroundSubtraction
from apex_lab.models.yardsticks.color_clusters import ColorClusters
from apex_lab.models.yardsticks.one_segment import OneSegment
from apex_lab.models.yardsticks.oracle import Oracle

__all__ = ["BackgroundSubtraction", "ColorClusters", "OneSegment", "Oracle"]
