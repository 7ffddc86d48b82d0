"""What is in the wheel, and that it works from any folder."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from hatchling.builders.wheel import WheelBuilder

from tests.conftest import REPOSITORY


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    return Path(next(WheelBuilder(str(REPOSITORY)).build(directory=str(folder), versions=["standard"])))


def test_the_wheel_holds_code_and_configuration_and_no_tests(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    for path in (REPOSITORY / "conf").rglob("*.yaml"):
        assert f"apex_lab/{path.relative_to(REPOSITORY)}" in names
    assert "apex_lab/conf/recipe/apex/paper.yaml" in names
    assert {"apex_lab/weights/apex_p2d_cpu.ckpt", "apex_lab/py.typed"} <= names
    for folder in ("src/apex_lab", "src/hydra_plugins", "sims", "recordings"):
        for path in (REPOSITORY / folder).rglob("*.py"):
            assert str(path.relative_to(REPOSITORY)).removeprefix("src/") in names
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {
        "apex_lab",
        "hydra_plugins",
        "recordings",
        "sims",
    }
    # naive twins are an oracle of the tests and a baseline of the benchmark, both in the repository alone
    twins = {path.name for path in (REPOSITORY / "tests" / "reference").glob("*.py")}
    assert "apex.py" in twins
    assert [name for name in names if "reference" in name.split("/") or "tests" in name.split("/")] == []


def test_the_wheel_s_own_configuration_is_used_from_any_folder(wheel: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    zipfile.ZipFile(wheel).extractall(site)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    environment = {**os.environ, "PYTHONPATH": str(site), "OMP_NUM_THREADS": "1"}

    def ask(*words: str) -> str:
        words = (sys.executable, *words)
        result = subprocess.run(words, cwd=elsewhere, env=environment, capture_output=True, text=True, check=True)
        return result.stdout

    where = "from apex_lab.config.composition import conf_dir; print(conf_dir())"
    told = ask("-c", f"{where}; from apex_lab.train import main; main()", "scale=smoke", "--cfg", "job")
    assert told.splitlines()[0] == str(site / "apex_lab/conf")
    assert "max_steps: 6\n" in told
    shipped = ask("-c", "from apex_lab.config.shipped import weights; print(weights('apex-p2d-cpu'))")
    assert shipped.strip() == str(site / "apex_lab/weights/apex_p2d_cpu.ckpt")
    assert list(elsewhere.iterdir()) == []
