"""apex_lab: APEX and its baselines for unsupervised video segmentation and tracking in robot manipulation."""

__version__ = "0.1.0"
