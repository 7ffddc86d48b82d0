"""Functions of the published implementation, by arrays of inputs and outputs, and its parameter counts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from apex_lab.models.gswm import Background, Gswm, ImageEncoder, Motion
from apex_lab.models.gswm.boxes import (
    cell_centres,
    discovered_box,
    gaussian_weight,
    overlap,
    paste_window,
    rejected,
    window_of,
)
from apex_lab.models.gswm.history import History
from apex_lab.models.gswm.latents import kl_bernoulli
from apex_lab.models.gswm.slots import keep
from apex_lab.nn.spatial_transformer import crop, paste
from apex_lab.training.schedules import Exponential, Linear, Staircase

PUBLISHED = dict(np.load(Path(__file__).parent / "fixtures" / "published.npz"))


def array(name: str) -> Tensor:
    return torch.from_numpy(PUBLISHED[name])


def close(got: Tensor, name: str) -> None:
    expected = array(name)
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-4 * expected.abs().max().item())


def test_crop_and_paste() -> None:
    where = array("stn_z_where")
    close(crop(array("stn_image"), window_of(where)[:, None], 8)[:, 0], "stn_fwd_8")
    close(paste(array("stn_glimpse"), paste_window(where), 16), "stn_inv_16")


def test_gaussian_weight() -> None:
    close(gaussian_weight(array("gauss_xy"), 0.1), "gauss_out_sigma0p1")


def test_kl_of_presence() -> None:
    got = torch.stack([kl_bernoulli(array("klb_probs"), prior) for prior in array("klb_priors")])
    close(got, "klb_out")


def test_annealing() -> None:
    steps = PUBLISHED["anneal_steps"].tolist()
    linear, exponential = Linear(-1.5, -1.75, 10000), Exponential(0.1, 1e-10, 9500, 500)
    close(torch.tensor([linear(step) for step in steps]), "anneal_linear")
    torch.testing.assert_close(
        torch.tensor([exponential(step) for step in steps]), array("anneal_exp"), rtol=1e-3, atol=0
    )


def test_cells_and_their_boxes() -> None:
    centres = cell_centres(4)
    close(centres.T.reshape(2, 4, 4), "offset_grid_G4")
    close(discovered_box(array("rel_z_where"), centres), "abs_z_where")


def test_overlap_and_rejection() -> None:
    found, tracked = array("iou_disc"), array("iou_prop")
    close(overlap(found, tracked), "iou_out")
    presence = array("rej_pres_disc")[..., 0]
    left = presence * (1 - rejected(found, tracked, array("rej_pres_prop")[..., 0], 0.8))
    close(left[..., None], "rej_out")


def test_selection_keeps_the_same_objects() -> None:
    """The published code sorts them by presence; here who was there keeps the slot."""
    presence, ids = array("sel_pres")[..., 0], array("sel_ids")
    kept = keep(presence[:, :4], presence[:, 4:], ids[:, 4:], torch.zeros(1, dtype=torch.long), 3, None)
    order = presence.argsort(dim=1, descending=True)[:, :3]
    assert set(kept.source[0].tolist()) == set(order[0].tolist())
    kept = keep(presence, None, None, torch.zeros(1, dtype=torch.long), 4, None)
    close(presence.gather(1, kept.source)[..., None], "sel_out_pres")
    assert ids.gather(1, kept.source).tolist() == array("sel_out_ids").tolist()


def test_curriculum() -> None:
    stairs = Staircase(PUBLISHED["curr_T"].tolist(), PUBLISHED["curr_milestones"].tolist())
    assert [int(stairs(step)) for step in PUBLISHED["curr_steps"].tolist()] == PUBLISHED["curr_out"].tolist()


def test_stairs_need_a_value_between_all_milestones() -> None:
    with pytest.raises(ValueError, match="one more value"):
        Staircase([2, 4], [1, 2])
    with pytest.raises(ValueError, match="must increase"):
        Staircase([2, 4, 6], [2, 1])


def count(*parts: nn.Module | nn.Parameter) -> int:
    return sum(
        part.numel() if isinstance(part, nn.Parameter) else sum(p.numel() for p in part.parameters()) for part in parts
    )


UNUSED = 256 + 129 * 256
"""Parameters of the published model that nothing reads: two start states and a part of discovery's head."""


@pytest.mark.parametrize(
    ("size", "grid", "glimpse", "published"),
    [(128, 4, 16, 12_777_723), (128, 8, 16, 12_777_723), (64, 4, 16, 8_839_419), (128, 4, 32, 12_900_987)],
)
def test_parameters(size: int, grid: int, glimpse: int, published: int) -> None:
    model = Gswm(size, ImageEncoder(size, grid), Background(size), Motion(), glimpse_size=glimpse)
    assert count(model) == published - UNUSED


@pytest.mark.parametrize(
    ("size", "unused", "total"),
    [(128, True, 12_777_723), (128, False, 12_744_443), (64, True, 8_839_419), (64, False, 8_806_139)],
)
def test_parameters_with_those_that_nothing_reads(size: int, unused: bool, total: int) -> None:
    model = Gswm(size, ImageEncoder(size), Background(size), Motion(), unused_parameters=unused)
    assert count(model) == total
    trained = sum(p.numel() for p in model.parameters() if p.requires_grad)
    assert trained == {128: 12_744_443, 64: 8_806_139}[size]


@pytest.mark.parametrize(
    ("environment", "published"), [("attention", 8_320_587), ("whole", 8_566_347), ("none", 8_566_347 - 360_192)]
)
def test_parameters_of_the_maze_model(environment: str, published: int) -> None:
    """Without surroundings, the published model has an encoder of them all the same."""
    background = Background(64, latent=16)
    model = Gswm(
        64,
        ImageEncoder(64, 8),
        background,
        Motion(),
        max_objects=16,
        what=16,
        environment=environment,  # type: ignore[arg-type]
    )
    assert count(model) == published - UNUSED


def test_parameters_of_the_parts() -> None:
    background = Background(128)
    model = Gswm(128, ImageEncoder(128), background, Motion())
    history, interaction = model.history, model.history.interaction
    propagation, discovery = model.propagation, model.discovery
    expected = {
        "background": (count(background), 7_614_444),
        "its encoder's convolutions": (count(background.encoder.convs), 1_560_576),
        "its encoder's linear layer": (count(background.encoder.head), 4_194_432),
        "its decoder's linear layer": (count(background.decoder.stem), 1_056_768),
        "its decoder's convolutions": (count(background.decoder.convs), 389_484),
        "its posterior's LSTM": (count(background.q_cell), 132_096),
        "its prior's LSTM": (count(background.p_lstm), 132_096),
        "its posterior": (count(background.q_net), 82_432),
        "its prior": (count(background.p_net), 66_048),
        "its start states": (count(background.start), 512),
        "image encoder": (count(model.image_encoder), 3_087_232),
        "proposal encoder": (count(propagation.encoder), 114_432),
        "proposal": (count(propagation.grow_net), 33_282),
        "glimpse decoder": (count(model.renderer), 398_384),
        "attribute head": (count(discovery.attribute_head), 100_875 - 129 * 256),
        "dynamics head": (count(discovery.dyna_head), 82_944),
        "posterior of dynamics": (count(propagation.q_net), 82_432),
        "prior of dynamics": (count(propagation.p_net), 66_048),
        "attributes given dynamics": (count(propagation.change_net), 59_856),
        "propagation map": (count(discovery.map_net), 58_496),
        "surroundings": (count(history.encoder), 114_432),
        "interaction: self": (count(interaction.self_net), 2 * 74_880),
        "interaction: pair": (count(interaction.pair_net), 2 * 116_608),
        "interaction: logit": (count(interaction.logit_net), 2 * 100_225),
        "LSTM input": (count(history.input), 2 * 58_240),
        "LSTM": (count(history.from_input, history.from_hidden), 2 * 132_096),
        "start states": (count(history.start), 512),
    }
    assert {name: got for name, (got, _) in expected.items()} == {
        name: number for name, (_, number) in expected.items()
    }


def test_the_scale_of_a_start_follows_the_published_layers() -> None:
    """Linear layers start within 1 / sqrt(inputs), LSTMs within 1 / sqrt(hidden)."""
    history = History(10, 16, "none", 0.0, 8, (4,))
    assert history.input.weight.abs().max() <= 1 / 42**0.5
    assert history.input.weight.abs().max() > 0.9 / 42**0.5
    assert 0.9 / 4 < history.from_input.weight.abs().max() <= 1 / 4
