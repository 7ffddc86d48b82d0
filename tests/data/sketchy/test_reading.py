"""Records, messages and images of an episode, read by the project and by the package `tfrecord`; damage is found."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tfrecord.reader import tfrecord_loader
from tfrecord.writer import TFRecordWriter

from apex_lab.data.sketchy.example import read_features
from apex_lab.data.sketchy.files import check_episode
from apex_lab.data.sketchy.tfrecord import OVERHEAD, DamagedFileError, Records, framed, masked_checksum
from tests.data.sketchy import episodes as written
from tests.data.sketchy.episodes import FRONT, Value, example, front_features, jpeg, plain, record, timestep_features


def as_file(folder: Path, *parts: bytes) -> Path:
    path = folder / written.episode_name(0)
    path.write_bytes(b"".join(parts))
    return path


def test_the_checksum_has_the_published_value() -> None:
    """The check value of CRC-32C, and the mask by its formula."""
    rotated = (0xE3069283 >> 15 | 0xE3069283 << 17) % 2**32
    assert masked_checksum(b"123456789") == (rotated + 0xA282EAD8) % 2**32


def test_an_episode_reads_as_the_package_tfrecord_reads_it(tmp_path: Path) -> None:
    path = written.write_episode(tmp_path, 3, 3, few=False)
    with Records(path) as records:
        found = [read_features(payload) for payload in records]
    oracle = list(tfrecord_loader(str(path), None))
    assert len(found) == len(oracle) == 3
    for timestep, (ours, theirs) in enumerate(zip(found, oracle, strict=True)):
        assert len(ours) == 30
        assert ours.keys() == theirs.keys() == timestep_features(timestep, 3).keys()
        for name, value in ours.items():
            if isinstance(value, list):
                assert value == [bytes(theirs[name])]
            else:
                assert value.dtype in (np.float32, np.int64)
                np.testing.assert_array_equal(value, np.ravel(theirs[name]))


def test_files_of_another_writer(tmp_path: Path) -> None:
    path = tmp_path / "written"
    writer = TFRecordWriter(str(path))
    for number in range(5):
        writer.write(
            {"image": (bytes([number]) * 1000, "byte"), "n": ([number, -number], "int"), "x": ([0.5, number], "float")}
        )
    writer.close()
    with Records(path) as records:
        assert len(records) == 5
        for number in (4, 0, 2):
            found = read_features(records[number], {"image", "n"})
            assert found.keys() == {"image", "n"}
            assert found["image"] == [bytes([number]) * 1000]
            np.testing.assert_array_equal(found["n"], [number, -number])


@pytest.mark.parametrize("packed", [True, False])
def test_lists_packed_and_one_by_one_in_any_order(packed: bool) -> None:
    features: dict[str, Value] = {
        "a": [1, -1, 2**63 - 1, -(2**63)],
        "b": [1.5, -2.25],
        "c": [b"", b"xy"],
        "unknown": [7],
    }
    for order in (list(features), list(features)[::-1]):
        found = read_features(example(features, packed, order), {"a", "b", "c", "absent"})
        assert found.keys() == {"a", "b", "c"}
        np.testing.assert_array_equal(found["a"], np.array(features["a"], dtype=np.int64))
        np.testing.assert_array_equal(found["b"], [1.5, -2.25])
        assert found["c"] == [b"", b"xy"]


def test_fields_of_later_versions_are_skipped() -> None:
    more = b"\x78\x05" + b"\x79" + bytes(8) + b"\x7d" + bytes(4) + written.delimited(15, b"new")
    message = more + example({"a": [3]}) + more
    np.testing.assert_array_equal(read_features(message)["a"], [3])


def test_no_message_is_taken_for_another(tmp_path: Path) -> None:
    """Cut anywhere, or with any byte changed, a message is read or refused in a sentence, never by another error."""
    message = example({"a": [1, 2, 3], "b": [1.0, 2.0], "c": [b"content"]})
    for length in range(len(message)):
        try:
            read_features(message[:length])
        except DamagedFileError:
            continue
    for place in range(len(message)):
        for value in (0, 0x7F, 0x80, 0xFF):
            changed = message[:place] + bytes([value]) + message[place + 1 :]
            try:
                read_features(changed)
            except DamagedFileError:
                continue


def test_records_are_framed_as_the_test_writer_frames_them() -> None:
    for payload in (b"", b"x", bytes(range(256)) * 5):
        assert framed(payload) == record(payload)
        assert len(framed(payload)) == len(payload) + OVERHEAD


def test_every_changed_byte_of_a_file_is_found(tmp_path: Path) -> None:
    content = record(b"first") + record(b"") + record(b"the third")
    for place in range(len(content)):
        changed = bytearray(content)
        changed[place] ^= 0x10
        with pytest.raises(DamagedFileError, match="record"), Records(as_file(tmp_path, bytes(changed))) as records:
            list(records)


def test_every_cut_of_a_file_is_found_but_between_records(tmp_path: Path) -> None:
    first = record(b"first")
    content = first + record(b"second")
    for length in range(1, len(content)):
        path = as_file(tmp_path, content[:length])
        if length == len(first):
            with Records(path) as records:
                assert list(records) == [b"first"]
        else:
            with pytest.raises(DamagedFileError, match="cut off in record"):
                Records(path)


def test_a_length_beyond_the_file_is_not_read(tmp_path: Path) -> None:
    length = struct.pack("<Q", 2**62)
    path = as_file(tmp_path, length + written.checksum(length) + b"short")
    with pytest.raises(DamagedFileError, match="cut off in record 0"):
        Records(path)


def features_with(name: str, value: Value | None) -> dict[str, Value]:
    features = front_features(0)
    if value is None:
        del features[name]
    else:
        features[name] = value
    return features


def claiming(height: int, width: int) -> bytes:
    """A JPEG whose header claims another size than it has."""
    image = bytearray(jpeg(plain(9)))
    size = image.find(b"\xff\xc0") + 5
    image[size : size + 4] = struct.pack(">HH", height, width)
    return bytes(image)


def grey() -> bytes:
    return jpeg(np.zeros((600, 960), np.uint8))


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (lambda: b"", "it is empty"),
        (lambda: record(b""), "pixels/basket_front_left of timestep 0: it is missing"),
        (lambda: record(b"\xff\xff"), "record of timestep 0: a number does not end"),
        (
            lambda: record(example(features_with(FRONT[1], None))),
            "pixels/basket_front_right of timestep 0: it is missing",
        ),
        (lambda: record(example(features_with(FRONT[0], [b"a", b"b"]))), "not one string of bytes"),
        (lambda: record(example(features_with(FRONT[0], [1.0]))), "not one string of bytes"),
        (lambda: record(example(features_with(FRONT[0], [b"a"]))), "no JPEG image"),
        (
            lambda: record(example(features_with(FRONT[0], [jpeg(plain(9, 480, 640))]))),
            "480 x 640 pixels RGB, not 600 x 960",
        ),
        (lambda: record(example(features_with(FRONT[0], [claiming(60000, 60000)]))), "an image of far more than 600"),
        (lambda: record(example(features_with(FRONT[0], [claiming(0, 960)]))), "no JPEG image"),
        (lambda: record(example(features_with(FRONT[0], [grey()]))), "600 x 960 pixels of mode L"),
        (
            lambda: record(example(features_with(FRONT[0], [jpeg(plain(9))[:-900]]))),
            "image of timestep 0: a damaged JPEG",
        ),
    ],
)
def test_an_episode_that_is_not_what_it_should_be(tmp_path: Path, content: Callable[[], bytes], sentence: str) -> None:
    with pytest.raises(DamagedFileError, match=sentence):
        check_episode(as_file(tmp_path, content()))


def test_a_flaw_in_a_later_timestep_is_found_and_named(tmp_path: Path) -> None:
    sound = record(example(front_features(0)))
    assert check_episode(as_file(tmp_path, sound, sound)) == 2
    with pytest.raises(DamagedFileError, match="pixels/basket_front_left of timestep 2: it is missing"):
        check_episode(as_file(tmp_path, sound, sound, record(example(features_with(FRONT[0], None)))))
