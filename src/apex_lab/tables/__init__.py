"""The paper's tables from run folders: `python -m apex_lab.tables` (metrics.md section 3).

spec       which runs make which table, and the published values (sweeps/tables/)
found      what run folders hold
choose     which runs stand in a row
rows       mean and deviation of every cell
build      bold entries, captions, notes
commands   the commands of missing runs
markdown, latex, export    the same tables as Markdown, LaTeX, JSON and CSV
"""

from __future__ import annotations

from apex_lab.tables.asked import main

__all__ = ["main"]
