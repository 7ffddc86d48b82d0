"""G-SWM, the Generative Structured World Model (Lin et al. 2020); see README.md."""

from apex_lab.models.gswm.background import Background
from apex_lab.models.gswm.image_encoder import ImageEncoder
from apex_lab.models.gswm.model import Gswm
from apex_lab.models.gswm.propagation import Motion

__all__ = ["Background", "Gswm", "ImageEncoder", "Motion"]
