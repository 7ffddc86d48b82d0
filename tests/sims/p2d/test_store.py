"""The arrays on the disk: readable by NumPy alone, exactly the simulated values, checked to the last bit."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from recordings import array_path
from recordings.files import Arrays
from sims.p2d.settings import Settings
from sims.p2d.store import FIELDS, SPLITS, fingerprint, layout, read_manifest
from sims.p2d.trajectory import Trajectory
from tests.fakes.p2d_fake import simulate
from tests.fakes.p2d_tools import content, make, small


def to_parts(settings: Settings, trajectory: Trajectory) -> dict[str, memoryview]:
    """The bytes of each field, as workers write them."""
    return layout(settings).parts({name: getattr(trajectory, name) for name in FIELDS}, "trajectory")


def test_fields_are_those_of_a_trajectory_in_their_order():
    assert list(FIELDS) == [field.name for field in dataclasses.fields(Trajectory)]


def test_numpy_reads_every_array_with_the_simulated_values(tmp_path: Path):
    settings = small(max_objects=4)
    make(tmp_path, settings)
    for split in SPLITS:
        for index in range(getattr(settings, split)):
            expected = simulate(settings, split, index)
            for name in FIELDS:
                stored = np.load(tmp_path / split / f"{name}.npy", mmap_mode="r")
                wanted = np.asarray(getattr(expected, name))
                assert stored.shape == (getattr(settings, split), *wanted.shape)
                np.testing.assert_array_equal(stored[index], wanted)
                if wanted.ndim:
                    assert stored.dtype == wanted.dtype


def test_header_is_what_numpy_would_write(tmp_path: Path):
    settings = small()
    for name, field in FIELDS.items():
        path = tmp_path / f"{name}.npy"
        path.write_bytes(
            layout(settings).header("train", name).ljust(layout(settings).array_bytes("train", name), b"\0")
        )
        array = np.load(path, allow_pickle=False)
        assert array.dtype == np.dtype(field.dtype)
        assert path.stat().st_size == 128 + array.nbytes


def test_sizes_add_up(tmp_path: Path):
    settings = small()
    make(tmp_path, settings)
    assert sum(path.stat().st_size for path in tmp_path.glob("*/*.npy")) == layout(settings).total_bytes()


@pytest.mark.parametrize("name", FIELDS)
def test_checksum_sees_every_field(name: str):
    settings = small()
    parts = to_parts(settings, simulate(settings, "train", 0))
    flipped = bytearray(parts[name])
    flipped[-1] ^= 1
    assert layout(settings).checksum(parts) != layout(settings).checksum({**parts, name: memoryview(flipped)})


def test_checksum_of_the_disk_is_that_of_the_arrays(tmp_path: Path):
    manifest = make(tmp_path)
    arrays = Arrays(tmp_path, "val", layout(small()))
    parts = to_parts(small(), simulate(small(), "val", 1))
    assert arrays.checksum(1) == layout(small()).checksum(parts) == manifest.records["val", 1].checksum
    arrays.close()


def test_a_trajectory_of_wrong_shape_or_type_is_refused():
    settings = small()
    good = simulate(settings, "train", 0)
    for changed in (
        {"rgb": good.rgb[:-1]},
        {"depth": good.depth.astype(np.float32)},
        {"redraws": 0.5},
        {"aimed": 1},
    ):
        with pytest.raises(ValueError, match=f"trajectory field {next(iter(changed))} is"):
            to_parts(settings, dataclasses.replace(good, **changed))


def test_empty_splits_are_arrays_too(tmp_path: Path):
    make(tmp_path, small(val=0))
    assert np.load(array_path(tmp_path, "val", "rgb")).shape == (0, 3, 16, 16, 3)


def test_fingerprint_changes_with_every_setting():
    changes = {"seed": 1, "train": 9, "frames": 4, "image_size": 17, "max_objects": 2, "aim": 0.25, "renderer": "egl"}
    found = {fingerprint(small())} | {fingerprint(small(**{key: value})) for key, value in changes.items()}
    assert len(found) == len(changes) + 1


def test_manifest_is_complete_and_reads_back(tmp_path: Path):
    made = make(tmp_path)
    read = read_manifest(tmp_path)
    assert read == made
    assert read.settings == small()
    assert read.fingerprint == fingerprint(small())
    assert read.facts["classes"] == list(small().objects)
    assert [read.records["test", i].notes["redraws"] for i in range(2)] == [
        simulate(small(), "test", i).redraws for i in range(2)
    ]


def test_content_differs_for_different_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    first = make(tmp_path / "a")
    monkeypatch.setenv("FAKE_OTHER_BYTES", "1")
    second = make(tmp_path / "b")
    assert first.fingerprint == second.fingerprint
    assert first.content != second.content


def test_readme_in_the_folder_documents_every_array(tmp_path: Path):
    make(tmp_path)
    text = content(tmp_path)["README.md"].decode()
    for name in FIELDS:
        assert f"`{name}.npy`" in text
    assert "(N, 3, 16, 16, 3)" in text
