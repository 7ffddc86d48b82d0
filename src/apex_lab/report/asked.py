"""A report of a sweep as one HTML file: tables beside the paper's, curves, pictures, settings, versions, failures.

python -m apex_lab.report +sweep=ablations scale=cpu
python -m apex_lab.report model=apex,space seed=0,1 scale=cpu megabytes=50
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from apex_lab.base import console
from apex_lab.base.errors import UserError
from apex_lab.base.files import make_folder, write_text
from apex_lab.report.assemble import Asked, assemble
from apex_lab.report.page import render
from apex_lab.runs.listed import listed
from apex_lab.tables import definition

FILE = "report.html"
