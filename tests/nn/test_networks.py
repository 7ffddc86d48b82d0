"""Shapes, causality and start values of the shared networks."""

import math

import pytest
import torch

from apex_lab.nn.blocks import BroadcastDecoder, GlimpseEncoder, SubpixelDecoder, group_norm
from apex_lab.nn.conv_lstm import ConvLSTM
from apex_lab.nn.dla import DLA, UpSample


def test_dla_has_stride_four_and_uses_every_parameter() -> None:
    net = DLA(12, (4, 6, 8, 10, 12, 14), (1, 2, 2, 1))
    out = net(torch.randn(2, 3, 64, 64))
    assert out.shape == (2, 12, 16, 16)
    out.square().sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in net.parameters())


def test_dla_refuses_wrong_depths() -> None:
    with pytest.raises(ValueError, match="6 widths and 4 depths"):
        DLA(12, (4, 6, 8), (1, 1, 1, 1))


def test_upsample_starts_as_bilinear_interpolation() -> None:
    x = torch.randn(1, 3, 6, 6)
    got = UpSample(3)(x)
    want = torch.nn.functional.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
    torch.testing.assert_close(got[..., 1:-1, 1:-1], want[..., 1:-1, 1:-1], rtol=0, atol=1e-6)


def test_conv_lstm_against_the_cell_equations() -> None:
    torch.manual_seed(0)
    net = ConvLSTM(3).double()
    x = torch.randn(2, 4, 3, 5, 5, dtype=torch.float64)
    h = c = torch.zeros(2, 3, 5, 5, dtype=torch.float64)
    for t in range(4):
        i, f, o, g = (net.from_input(x[:, t]) + net.from_hidden(h)).chunk(4, 1)
        c = f.sigmoid() * c + i.sigmoid() * g.tanh()
        h = o.sigmoid() * c.tanh()
        torch.testing.assert_close(net(x)[0][:, t], h)


def test_conv_lstm_sees_no_future() -> None:
    net = ConvLSTM(3)
    x = torch.randn(1, 4, 3, 5, 5)
    y = x.clone()
    y[:, 3] += 1
    torch.testing.assert_close(net(x)[0][:, :3], net(y)[0][:, :3])


def test_conv_lstm_in_chunks_gives_what_it_gives_at_once() -> None:
    net, x = ConvLSTM(3).double(), torch.randn(1, 5, 3, 5, 5, dtype=torch.float64)
    whole, end = net(x)
    first, state = net(x[:, :2])
    second, last = net(x[:, 2:], state)
    torch.testing.assert_close(torch.cat([first, second], dim=1), whole)
    torch.testing.assert_close(last, end)


@pytest.mark.parametrize("size", [8, 16, 32, 64])
def test_subpixel_decoder_size(size: int) -> None:
    assert SubpixelDecoder(5, size, 4, 3)(torch.randn(2, 5)).shape == (2, 3, size, size)


@pytest.mark.parametrize("size", [4, 12, 20])
def test_subpixel_decoder_refuses_other_sizes(size: int) -> None:
    with pytest.raises(ValueError, match="4 times a power of two"):
        SubpixelDecoder(5, size, 4, 3)


def test_broadcast_decoder_and_glimpse_encoder_sizes() -> None:
    assert BroadcastDecoder(5, 32, 8, 3)(torch.randn(2, 5)).shape == (2, 3, 32, 32)
    assert GlimpseEncoder(6, 12, 8, 10)(torch.randn(2, 6, 12, 12)).shape == (2, 10)
    assert group_norm(30)(torch.randn(1, 30, 2, 2)).shape == (1, 30, 2, 2)


@torch.no_grad()
def test_a_crop_s_code_is_that_of_its_convolutions_and_a_weighted_sum_of_its_pixels() -> None:
    torch.manual_seed(2)
    net = GlimpseEncoder(2, 6, 8, 5).double()
    crops = torch.randn(3, 2, 6, 6, dtype=torch.float64)
    assert net.shortcut is not None
    weights = net.shortcut.weight.tolist()
    sums = torch.zeros(3, 5, dtype=torch.float64)
    for n, crop in enumerate(crops.tolist()):
        pixels = [value for channel in crop for row in channel for value in row]
        for k in range(5):
            sums[n, k] = sum(w * value for w, value in zip(weights[k], pixels, strict=True))
    features = net.convs(crops).flatten(1) @ net.head[0].weight.T + net.head[0].bias
    seen = torch.where(features > 0, features, features.exp() - 1)  # CELU
    for part in (seen, sums):
        assert part.std() > 0.1
    torch.testing.assert_close(net(crops), seen + sums, rtol=0, atol=1e-12)
    plain = GlimpseEncoder(2, 6, 8, 5, shortcut=False).double()
    plain.load_state_dict({name: value for name, value in net.state_dict().items() if name != "shortcut.weight"})
    torch.testing.assert_close(plain(crops), seen, rtol=0, atol=1e-12)


@torch.no_grad()
def test_the_shortcut_of_a_crop_is_linear_and_has_no_bias() -> None:
    net = GlimpseEncoder(3, 8, 4, 5).double()
    for p in net.head.parameters():
        p.zero_()
    a, b = torch.randn(2, 1, 3, 8, 8, dtype=torch.float64)
    assert (net(0 * a) == 0).all()
    torch.testing.assert_close(net(2 * a - 3 * b), 2 * net(a) - 3 * net(b))
    assert net(a).abs().sum() > 0


def test_conv_lstm_against_loops_over_channels_and_pixels() -> None:
    """Gates as sums over the 3 x 3 neighbourhood of inputs and of the hidden state before."""
    torch.manual_seed(1)
    c, h, w = 2, 3, 4
    net = ConvLSTM(c).double()
    x = torch.randn(1, 3, c, h, w, dtype=torch.float64)
    kernel_x, kernel_h, bias = (
        p.tolist() for p in (net.from_input.weight, net.from_hidden.weight, net.from_input.bias)
    )
    hidden = [[[0.0] * w for _ in range(h)] for _ in range(c)]
    cell = [[[0.0] * w for _ in range(h)] for _ in range(c)]

    def gate(index: int, picture: list, state: list, y: int, z: int) -> float:
        total = bias[index]
        for i in range(c):
            for dy in range(3):
                for dx in range(3):
                    yy, xx = y + dy - 1, z + dx - 1
                    if 0 <= yy < h and 0 <= xx < w:
                        total += kernel_x[index][i][dy][dx] * picture[i][yy][xx]
                        total += kernel_h[index][i][dy][dx] * state[i][yy][xx]
        return total

    def sigmoid(value: float) -> float:
        return 1 / (1 + math.exp(-value))

    out, state_after = net(x)
    for t in range(3):
        picture, state = x[0, t].tolist(), hidden
        hidden = [[[0.0] * w for _ in range(h)] for _ in range(c)]
        for k in range(c):
            for y in range(h):
                for z in range(w):
                    enter, forget, leave, new = (gate(k + n * c, picture, state, y, z) for n in range(4))
                    cell[k][y][z] = sigmoid(forget) * cell[k][y][z] + sigmoid(enter) * math.tanh(new)
                    hidden[k][y][z] = sigmoid(leave) * math.tanh(cell[k][y][z])
        torch.testing.assert_close(out[0, t], torch.tensor(hidden, dtype=torch.float64))
    for found, want in zip(state_after, (hidden, cell), strict=True):
        torch.testing.assert_close(found[0], torch.tensor(want, dtype=torch.float64))
