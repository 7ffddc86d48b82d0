"""SPACE (Lin et al. 2020): objects on a grid of cells, a scene mixture as background, single images."""

from apex_lab.models.space.model import Space

__all__ = ["Space"]
