"""`python -m apex_lab.report`."""

from __future__ import annotations

from apex_lab.report.asked import main

if __name__ == "__main__":
    main()
