"""Sprites as a data set: drawn when they are read, or once into a recording. `source` needs PyTorch."""
