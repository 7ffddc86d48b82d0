"""Impossible settings are refused."""

from __future__ import annotations

import json

import pytest
from pydantic import ValidationError

from sims.camera import Camera
from sims.p2d.settings import Settings


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"min_objects": 3, "max_objects": 2}, "min_objects 3 must not exceed max_objects 2"),
        ({"max_objects": 15}, "max_objects"),
        ({"frames": 0}, "frames"),
        ({"frames": 2.5}, "frames"),
        ({"frames": "20"}, "frames"),
        ({"image_size": 8}, "image_size"),
        ({"aim": 1.5}, "aim"),
        ({"seed": -1}, "seed"),
        ({"renderer": "opengl"}, "renderer"),
        ({"objects": ("mug", "mug", "banana")}, "names a class twice"),
        ({"objects": ("mug", "banana")}, "max_objects 3 needs as many classes"),
        ({"workspace_x": (0.6, 0.5)}, "workspace_x"),
        ({"speed_m_s": 0.0}, "speed_m_s"),
        ({"frame": 20}, "frame"),
        ({"camera": {"field": 3}}, "field"),
    ],
)
def test_impossible_settings_are_refused(change: dict[str, object], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        Settings.model_validate(change)


def test_settings_come_back_from_json_and_from_lists() -> None:
    settings = Settings(camera=Camera(eye=(1.0, 0.2, 0.6)), workspace_y=(-0.2, 0.1), objects=("mug", "pear", "apple"))
    assert Settings.model_validate_json(settings.model_dump_json()) == settings
    assert Settings.model_validate(json.loads(settings.model_dump_json())) == settings
    assert hash(settings) == hash(Settings.model_validate_json(settings.model_dump_json()))


def test_defaults_are_the_papers() -> None:
    settings = Settings()
    assert (settings.train, settings.val, settings.test) == (2000, 200, 200)
    assert (settings.frames, settings.image_size) == (20, 128)
    assert (settings.min_objects, settings.max_objects, len(settings.objects)) == (1, 3, 14)
