"""`python -m apex_lab.dashboards`."""

from __future__ import annotations

from apex_lab.dashboards.asked import main

if __name__ == "__main__":
    main()
