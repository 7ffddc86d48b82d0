"""Yardstick: the ground truth as a model."""

from apex_lab.models.oracle.model import Oracle

__all__ = ["Oracle"]
