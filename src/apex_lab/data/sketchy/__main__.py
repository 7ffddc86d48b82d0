"""`python -m apex_lab.data.sketchy`."""

from __future__ import annotations

from apex_lab.data.sketchy.command import main

if __name__ == "__main__":
    main()
