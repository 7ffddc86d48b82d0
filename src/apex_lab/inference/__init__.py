"""Inference that evaluation, validation and pictures share: a loaded model, and how it is called."""
