"""Yardstick: the whole image in one segment."""

from apex_lab.models.one_segment.model import OneSegment

__all__ = ["OneSegment"]
