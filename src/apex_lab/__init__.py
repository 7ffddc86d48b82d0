"""apex_lab: APEX and its baselines for unsupervised video segmentation and tracking in robot manipulation."""

import os

# Before PyTorch is imported: its CPU threads sleep while they wait for each other. By default they spin, which makes a
# training step ten times slower as soon as anything else (data workers, a second run) wants the same cores.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"
