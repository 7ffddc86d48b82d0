"""The scene encoder: features of single frames from DLA and colours, and what the ConvLSTM adds to them."""

from __future__ import annotations

import torch
from torch import Tensor

from apex_lab.models.apex import ApexEncoder
from tests.models.apex.small import SIZE, redraw, video


def encoder() -> ApexEncoder:
    """With weights that are drawn, so that no part is silent or starts as something simple."""
    net = ApexEncoder(8, (4, 4, 6, 8, 8, 8), (1, 1, 1, 1))
    redraw(net)
    return net.double()


def averaged(image: Tensor) -> Tensor:
    """Mean of every 4 x 4 block of (3, H, W), block by block."""
    side = SIZE // 4
    blocks = [[image[:, 4 * y : 4 * y + 4, 4 * x : 4 * x + 4].mean((1, 2)) for x in range(side)] for y in range(side)]
    return torch.stack([torch.stack(row, dim=1) for row in blocks], dim=1)


@torch.no_grad()
def test_features_are_dla_and_colours_and_what_the_lstm_makes_of_both() -> None:
    net, x = encoder(), video(2, 4).double()
    got, state = net(x)
    assert got.shape == (2, 4, 8, SIZE // 4, SIZE // 4)
    for b in range(2):
        h = c = torch.zeros(1, 8, SIZE // 4, SIZE // 4, dtype=torch.float64)
        for t in range(4):
            image = x[b, t] - 0.5
            assert net.colour is not None
            colour = torch.tensordot(net.colour.weight[:, :, 0, 0], averaged(image), dims=1)
            f = net.dla(image[None]) + colour[None]
            i, forget, o, new = (net.over_time.from_input(f) + net.over_time.from_hidden(h)).chunk(4, dim=1)
            c = forget.sigmoid() * c + i.sigmoid() * new.tanh()
            h = o.sigmoid() * c.tanh()
            for part in (net.dla(image[None]), colour, h):
                assert part.std() > 0.01  # none of the three could be missing unseen
            torch.testing.assert_close(got[b, t], (f + h)[0], rtol=0, atol=1e-12)
        for last, want in zip(state, (h, c), strict=True):
            torch.testing.assert_close(last[b], want[0], rtol=0, atol=1e-12)


@torch.no_grad()
def test_without_shortcuts_features_are_what_the_lstm_makes_of_dla_s() -> None:
    net = ApexEncoder(8, (4, 4, 6, 8, 8, 8), (1, 1, 1, 1), shortcuts=False)
    redraw(net)
    net, x = net.double(), video(1, 3).double()
    assert {name.split(".")[0] for name, _ in net.named_parameters()} == {"dla", "over_time"}
    got, _ = net(x)
    h = c = torch.zeros(1, 8, SIZE // 4, SIZE // 4, dtype=torch.float64)
    for t in range(3):
        f = net.dla(x[:, t] - 0.5)
        i, forget, o, new = (net.over_time.from_input(f) + net.over_time.from_hidden(h)).chunk(4, dim=1)
        c = forget.sigmoid() * c + i.sigmoid() * new.tanh()
        h = o.sigmoid() * c.tanh()
        torch.testing.assert_close(got[:, t], h, rtol=0, atol=1e-12)


@torch.no_grad()
def test_with_dla_and_lstm_silent_the_colours_remain() -> None:
    net, x = encoder(), video(1, 2).double()
    for part in (net.dla.head, net.over_time.from_input, net.over_time.from_hidden):
        for p in part.parameters():
            p.zero_()
    for t in range(2):
        assert net.colour is not None
        want = torch.einsum("fc,cyx->fyx", net.colour.weight[:, :, 0, 0], averaged(x[0, t] - 0.5))
        torch.testing.assert_close(net(x)[0][0, t], want, rtol=0, atol=1e-12)
    grey = torch.full_like(x, 0.5)
    assert (net(grey)[0] == 0).all()  # colours are told from grey


@torch.no_grad()
def test_colours_start_at_the_scale_of_features() -> None:
    """Standard normal weights, so that red, green and blue are far apart in e_t from the first step on."""
    torch.manual_seed(0)
    net = ApexEncoder(256, (4, 4, 6, 8, 8, 8), (1, 1, 1, 1))
    assert net.colour is not None
    assert net.colour.bias is None
    assert 0.9 < net.colour.weight.std() < 1.1
    assert net.colour.weight.mean().abs() < 0.15
