"""Every model and every ablation: trains a step (if it trains at all), is scored, drawn and evaluated again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY, Ended

CONF = REPOSITORY / "conf"
SMALL = ("--config-dir", str(REPOSITORY / "tests" / "conf"), "data=squares", "scale=smoke", "trainer.max_steps=2")


def words(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


@pytest.mark.parametrize(
    "choice", [*(f"model={w}" for w in words("model")), *(f"+ablation={w}" for w in words("ablation"))]
)
def test_from_the_command_line_to_its_scores(
    choice: str, command: Callable[..., Ended], the_run: Callable[..., Path]
) -> None:
    ended = command("train", *SMALL, choice, f"evaluation.pictures={int(choice == 'model=apex')}")
    assert ended.code == 0, ended.err
    ended = command("evaluate", f"checkpoint={the_run()}", "pictures=0")
    assert ended.code == 0, ended.err
