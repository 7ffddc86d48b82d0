"""The map of equations in the package's docstring is true, and no equation of the paper is missing from it."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

import apex_lab.models.apex as apex

FOLDER = Path(str(apex.__file__)).parent
LINE = re.compile(r"^Eq\. (\d+) +(\w+\.py) +`(\w+)` +\S")
MAP = {int(m[1]): (m[2], m[3]) for line in str(apex.__doc__).splitlines() if (m := LINE.match(line))}


def source_of(file: str, name: str) -> str:
    """All that the named classes and functions of a file say."""
    text = (FOLDER / file).read_text()
    kinds = (ast.ClassDef, ast.FunctionDef)
    found = [node for node in ast.walk(ast.parse(text)) if isinstance(node, kinds) and node.name == name]
    return "\n".join(str(ast.get_source_segment(text, node)) for node in found)


def test_every_equation_of_the_paper_is_on_the_map() -> None:
    assert sorted(MAP) == list(range(1, 23))


@pytest.mark.parametrize("number", sorted(MAP))
def test_the_number_stands_where_the_map_says(number: int) -> None:
    file, name = MAP[number]
    assert re.search(rf"Eq\. {number}\b", source_of(file, name)), f"Eq. {number} is not named in {file}, {name}"


def test_no_other_number_is_cited() -> None:
    cited = {int(n) for path in FOLDER.glob("*.py") for n in re.findall(r"Eq\. (\d+)", path.read_text())}
    assert cited == set(range(1, 23))
