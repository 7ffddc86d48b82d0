"""Masks, tracks and tables of a person's own videos (`python -m apex_lab.predict`, `apex_lab.load`)."""
