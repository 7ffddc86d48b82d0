"""`python -m apex_lab.tables`."""

from __future__ import annotations

from apex_lab.tables.asked import main

if __name__ == "__main__":
    main()
