"""Work in parts gives what work on everything at once gives."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from apex_lab.config.building import build_model, build_schedules
from apex_lab.nn import splitting as parts
from apex_lab.nn.splitting import joined, part_size
from apex_lab.scene import Context, schedule_at
from tests.conftest import compose_job


def test_a_part_on_a_cpu_has_tensors_of_the_cached_size_and_at_least_one_thing() -> None:
    single, double = torch.zeros(1), torch.zeros(1, dtype=torch.float64)
    assert part_size(1000, parts.CACHED // 4 // 10, single) == 10
    assert part_size(1000, parts.CACHED // 4 // 10, double) == 5
    assert part_size(3, 1, single) == 3
    assert part_size(3, parts.CACHED, single) == 1


def test_other_devices_do_all_at_once() -> None:
    assert part_size(1000, parts.CACHED, torch.zeros(1, device="meta")) == 1000


def test_joined_is_the_whole() -> None:
    whole = torch.randn(7, 2)
    assert torch.equal(joined(whole.split(3)), whole)
    assert joined(iter([whole])) is whole


@pytest.mark.parametrize("words", [(), ("+ablation=image_stn",), ("+ablation=gaussian_scalor_norm",)], ids=" ".join)
def test_apex_gives_the_same_in_parts(monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]) -> None:
    job = compose_job("model=apex", "data=p2d", "scale=smoke", "model.start_presence=0.7", *words)
    model = build_model(job.config).double()
    schedule = schedule_at({name: value(3) for name, value in build_schedules(job.config).items()})
    video = torch.rand(2, 3, 3, 32, 32, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def told(cached: int) -> tuple[dict[str, Tensor], list[Tensor]]:
        monkeypatch.setattr(parts, "CACHED", cached)
        torch.manual_seed(1)
        scene = model.train()(video, Context(schedule))
        gradients = torch.autograd.grad(
            sum(term.sum() for term in scene.terms.values()), list(model.parameters()), allow_unused=True
        )
        return {**scene.terms, "masks": scene.masks, "picture": scene.reconstruction}, [
            torch.zeros(()) if g is None else g for g in gradients
        ]

    (whole, gradients), (in_parts, gradients_in_parts) = told(2**40), told(1)
    for name, value in whole.items():
        torch.testing.assert_close(in_parts[name], value, rtol=1e-9, atol=1e-9, msg=name)
    for a, b in zip(gradients_in_parts, gradients, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-7, atol=1e-7 * float(b.abs().max()) + 1e-12)
