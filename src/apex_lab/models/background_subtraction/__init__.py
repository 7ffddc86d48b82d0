"""Yardstick: difference to the training set's per-pixel median plus connected components."""

from apex_lab.models.background_subtraction.model import BackgroundSubtraction

__all__ = ["BackgroundSubtraction"]
