"""What the paper states, and the schedules, at the paper's scale."""

from __future__ import annotations

import pytest

from apex_lab.config import components
from tests.models.apex.small import resolved


def test_values_of_the_paper() -> None:
    config = resolved("model=apex", "data=p2d", "scale=paper")
    model = config["model"]
    assert (model["likelihood"]["sigma_fg"], model["likelihood"]["sigma_bg"]) == (0.1, 0.04)
    assert model["likelihood"]["mixture_over"] == "channel"
    assert model["masks"]["outside"] == "zero"
    assert model["kl"] == "inclusive"
    assert config["optimizer"] == {"_target_": "torch.optim.Adam", "lr": 1e-4}
    assert (config["clips"]["batch_size"], config["data"]["frames"], config["trainer"]["max_steps"]) == (4, 20, 40_000)
    assert config["clips"]["frames"] is None  # whole videos
    terms = ("nll", "kl_what", "kl_where", "kl_pres", "kl_background", "mask_entropy")
    assert config["loss"] == dict.fromkeys(terms, 1.0)  # the last one is lambda_H; loose_windows is not the paper's


def test_schedules_at_the_paper_s_scale() -> None:
    nodes = resolved("model=apex", "data=p2d", "scale=paper")["schedule"]
    schedules = {name: components.build(node, f"schedule.{name}") for name, node in nodes.items()}
    temperature, p0 = schedules["temperature"], schedules["discovery_presence"]
    assert [temperature(s) for s in (0, 10_000, 20_000, 40_000)] == pytest.approx([1.0, 0.65, 0.3, 0.3])
    assert [p0(s) for s in (0, 5_000, 10_000, 40_000)] == pytest.approx([0.1, 0.01, 1e-3, 1e-3])
    assert [schedules["carry"](s) for s in (0, 500, 40_000)] == [1.0, 1.0, 1.0]  # full sequences
    assert [schedules["discover"](s) for s in (0, 500, 40_000)] == [1.0, 1.0, 1.0]
    for sigma in ("sigma_fg_scale", "sigma_bg_scale"):
        assert [schedules[sigma](s) for s in (0, 500, 40_000)] == [1.0, 1.0, 1.0]


@pytest.mark.parametrize(("scale", "first", "last"), [("paper", 1.0, 1.0), ("cpu", 2.0, 1.0), ("quickstart", 2.0, 2.0)])
def test_sigma_fg_at_the_ends_of_a_training(scale: str, first: float, last: float) -> None:
    config = resolved("model=apex", "data=p2d", f"scale={scale}")
    sigma_fg = components.build(config["schedule"]["sigma_fg_scale"], "schedule.sigma_fg_scale")
    assert (sigma_fg(0), sigma_fg(config["trainer"]["max_steps"])) == (first, last)


def test_the_recipe_of_p2d_shrinks_windows_once_objects_are_there_and_refines_later() -> None:
    config = resolved("model=apex", "data=p2d", "scale=cpu")
    loose = components.build(config["loss"]["loose_windows"], "loss.loose_windows")
    assert [loose(step) for step in (0, 275, 550, 825, 5_500)] == [0.0, 0.0, 100.0, 200.0, 200.0]
    assert config["loss"]["kl_pres"] == 8.0
    shadow = components.build(config["schedule"]["shadow"], "schedule.shadow")
    assert [shadow(step) for step in (0, 1_650, 1_705, 1_925, 5_500)] == pytest.approx([0, 0, 0.2, 1, 1])
    refinement = components.build(config["schedule"]["refinement"], "schedule.refinement")
    assert [refinement(step) for step in (0, 4_950, 5_005, 5_225, 5_500)] == pytest.approx([0, 0, 0.2, 1, 1])
    rate = components.build(config["lr_scale"], "lr_scale")
    assert (rate(1_650), rate(config["trainer"]["max_steps"])) == (1.0, pytest.approx(0.05))


def test_the_recipe_of_p2d_is_that_of_scale_cpu_in_batches_of_four() -> None:
    p2d, others = (resolved("model=apex", f"data={data}", "scale=cpu") for data in ("p2d", "sprites"))
    assert (p2d["clips"]["batch_size"], others["clips"]["batch_size"]) == (4, 2)
    for group, name in [
        *(("schedule", name) for name in ("temperature", "discovery_presence", "carry", "sigma_fg_scale")),
        ("schedule", "sigma_bg_scale"),
        ("loss", "kl_what"),
    ]:
        ours, theirs = p2d[group][name], others[group][name]
        assert {key: round(0.55 * theirs[key]) for key in ("delay", "steps") if theirs.get(key)} == {
            key: ours[key] for key in ("delay", "steps") if ours.get(key)
        }


@pytest.mark.parametrize(
    ("data", "scale"), [("p2d", "paper"), ("p2d", "smoke"), ("sprites", "cpu"), ("sketchy", "paper")]
)
def test_what_is_not_the_papers_is_off_elsewhere(data: str, scale: str) -> None:
    model = resolved("model=apex", f"data={data}", f"scale={scale}")["model"]
    assert (model["merges"], model["piece_price"], model["hollow_price"], model["pixel_features"]) == (0, 0.0, 0.0, 0)
    assert model["background"]["shadow"] == 1.0
    assert not model["whole_colours"]
