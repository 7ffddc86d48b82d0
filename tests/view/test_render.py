"""Everything at once, and disks that refuse."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from apex_lab.base.errors import UserError
from apex_lab.view import render_all
from tests.view.scenes import item


def test_all_pictures_are_made_and_named(tmp_path: Path) -> None:
    (tmp_path / "curves.csv").write_text("step,train/loss\n1,3.5\n2,3.0\n")
    folder = tmp_path / "new" / "view"
    paths = render_all(folder, [item("video 3, ARI 0.9"), item("worst/../video")], tmp_path / "curves.csv")
    assert [path.name for path in paths] == [
        "film_strip.png",
        "movie.mp4",
        "movie.gif",
        "components_video_3_ari_0.9.png",
        "components_worst_.._video.png",
        "curves.png",
    ]
    assert sorted(folder.iterdir()) == sorted(paths)
    for path in paths:
        if path.suffix != ".mp4":
            Image.open(path).verify()
    assert render_all(folder, [item("video 3, ARI 0.9")])[-1].name == "components_video_3_ari_0.9.png"


def test_names_must_differ(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected all different"):
        render_all(tmp_path, [item("video 1"), item("video 1")])
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        render_all(tmp_path / "file" / "view", [item()])


@pytest.mark.skipif(sys.platform == "win32", reason="limits the size of files, which Windows cannot")
def test_a_full_disk_is_told_and_leaves_nothing_behind(tmp_path: Path) -> None:
    """A limit of 2 kB per file stands for the full disk: writing fails in the middle in the same way."""
    code = f"""
import resource
from pathlib import Path
from apex_lab.base.errors import UserError
from apex_lab.view import component_panels, curve_page, film_strip, movie
from tests.view.scenes import item
folder, table = Path({str(tmp_path / "view")!r}), Path({str(tmp_path / "curves.csv")!r})
table.write_text("step,train/loss\\n1,2.0\\n")
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))
for make, name, content in (
    (film_strip, "strip.png", [item()]),
    (movie, "movie.mp4", [item()]),
    (movie, "movie.gif", [item()]),
    (component_panels, "components.png", item()),
    (curve_page, "curves.png", table),
):
    try:
        make(folder / name, content)
    except UserError as error:
        print(error)
"""
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    sentences = told.stdout.splitlines()
    assert [Path(sentence.split(" cannot be written")[0]).name for sentence in sentences] == [
        "strip.png",
        "movie.mp4",
        "movie.gif",
        "components.png",
        "curves.png",
    ], told.stderr
    assert not list((tmp_path / "view").iterdir())
