"""A workspace and a report on Weights & Biases for the runs of a sweep: `python -m apex_lab.dashboards`.

asked      the command
content    what both show: configurations, names of logged values, tables, studies
keys       which values runs log, and the topics they belong to
studies    studies of the two sigmas, and their trials
panels     panels over logged values
workspace  the workspace, section by section
report     the report, block by block
saving     sends both, and remembers where they are, so that the next time updates them

Only `panels`, `workspace`, `report` and `saving` import wandb-workspaces, an extra.
"""

from __future__ import annotations

from apex_lab.dashboards.asked import main

__all__ = ["main"]
