"""Baseline: SCALOR (Jiang et al. 2020)."""

from apex_lab.models.scalor.model import Scalor
from apex_lab.models.scalor.windows import AnchoredSize, FreeSize

__all__ = ["AnchoredSize", "FreeSize", "Scalor"]
