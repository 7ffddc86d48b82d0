"""Yardstick: colour k-means plus connected components."""

from apex_lab.models.color_clusters.model import ColorClusters

__all__ = ["ColorClusters"]
