"""The folder of data sets, `data.root`, is checked alike by every data set that is stored there."""

from __future__ import annotations

from typing import Any

import pytest

from apex_lab.base.errors import UserError
from apex_lab.config import components

SOURCES = {
    "P2DSource": {},
    "SpritesSource": {},
    "ArrangementSource": {},
    "SketchySource": {},
    "OwnVideosSource": {"path": "videos"},
}


@pytest.mark.parametrize(("name", "further"), SOURCES.items())
def test_an_empty_folder_is_no_folder(name: str, further: dict[str, Any]) -> None:
    node = {"_target_": f"apex_lab.data.{name}", **further}
    components.check({**node, "root": "data"}, "data")
    with pytest.raises(UserError, match=r"data\.root = '' is wrong"):
        components.check({**node, "root": ""}, "data")
