"""The paper's tables from the runs of a sweep's jobs: `python -m apex_lab.tables` (docs/metrics.md, section 3).

asked           the command: its own keys, and the words of its jobs
definition      rows and columns of the tables, and the published values (sweeps/tables/)
configurations  the jobs of one configuration with their runs: what stands in a row
found           what a run folder holds
rows            mean and deviation of every cell
build           bold entries, captions, notes
missing_runs    the commands of missing runs
markdown, latex, output_files    the same tables as Markdown, LaTeX, JSON and CSV
"""

from __future__ import annotations

from apex_lab.tables.asked import main

__all__ = ["main"]
