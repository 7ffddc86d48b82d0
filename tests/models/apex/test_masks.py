"""Mask normalisation: sums, absent components, and the equations of the paper written out naively in float64."""

import pytest
import torch
import torch.nn.functional as F

from apex_lab.models.apex.masks import ApexNormalisation, MaskNormalisation, ScalorNormalisation
from apex_lab.nn.spatial_transformer import Paster, paste

B, K, G, SIZE = 3, 5, 8, 16


def scene(present: int, dtype: torch.dtype = torch.float64, seed: int = 0) -> tuple[torch.Tensor, ...]:
    g = torch.Generator().manual_seed(seed)
    raw = 3 * torch.randn(B, K, G, G, generator=g, dtype=dtype)
    valid = (torch.arange(K) < present).expand(B, K)
    presence = torch.rand(B, K, generator=g, dtype=dtype) * valid
    windows = torch.cat(
        [0.1 + 0.8 * torch.rand(B, K, 2, generator=g), 2 * torch.rand(B, K, 2, generator=g) - 1], -1
    ).to(dtype)
    return raw, presence, valid, windows


@pytest.mark.parametrize("masks", [ApexNormalisation(), ApexNormalisation(3.0, "minus_c"), ScalorNormalisation()])
@pytest.mark.parametrize("present", [0, 1, K])
@pytest.mark.parametrize("seed", range(5))
def test_masks_sum_to_one(masks: MaskNormalisation, present: int, seed: int) -> None:
    raw, presence, valid, windows = scene(present, torch.float32, seed)
    out = masks.compose(masks.logits(raw), presence, valid, Paster(windows, G, SIZE))
    total = out.objects.sum(-3) + out.background
    assert (total - 1).abs().max() <= 1e-6
    assert (out.objects >= 0).all()
    assert (out.background >= 0).all()
    logs = torch.logaddexp(torch.logsumexp(out.log_objects, -3), out.log_background)
    assert logs.abs().max() < 2e-5


@pytest.mark.parametrize("seed", range(6))
def test_ten_strong_objects_in_float32_sum_to_one(seed: int) -> None:
    """Logits of 3 c = 15 have a spacing of 1e-6 in float32; the sum must not inherit it."""
    g = torch.Generator().manual_seed(seed)
    alpha = ApexNormalisation().logits(3 * torch.randn(4, 10, G, G, generator=g))
    windows = torch.cat([0.1 + 0.8 * torch.rand(4, 10, 2, generator=g), 2 * torch.rand(4, 10, 2, generator=g) - 1], -1)
    there = torch.ones(4, 10, dtype=torch.bool)
    out = ApexNormalisation().compose(alpha, there.float(), there, Paster(windows, G, 64))
    assert (out.objects.double().sum(-3) + out.background.double() - 1).abs().max() <= 7e-7


@pytest.mark.parametrize("masks", [ApexNormalisation(), ScalorNormalisation()])
def test_absent_components_are_exactly_nothing(masks: MaskNormalisation) -> None:
    raw, presence, valid, windows = scene(2)
    out = masks.compose(masks.logits(raw), presence, valid, Paster(windows, G, SIZE))
    assert (out.objects[:, 2:] == 0).all()
    assert (out.log_objects[:, 2:] == -torch.inf).all()
    few = masks.compose(masks.logits(raw[:, :2]), presence[:, :2], valid[:, :2], Paster(windows[:, :2], G, SIZE))
    torch.testing.assert_close(out.objects[:, :2], few.objects, rtol=0, atol=1e-15)
    none = masks.foreground(masks.logits(raw), torch.zeros(B, K, dtype=torch.float64), Paster(windows, G, SIZE))
    assert (none == 0).all()


@pytest.mark.parametrize("masks", [ApexNormalisation(), ApexNormalisation(5.0, "minus_c"), ScalorNormalisation()])
@pytest.mark.parametrize("present", [0, 2])
def test_what_absent_components_hold_does_not_matter(masks: MaskNormalisation, present: int) -> None:
    raw, presence, valid, windows = scene(present)
    paster = Paster(windows, G, SIZE)
    rubbish = torch.where(valid, presence, torch.full_like(presence, 0.6))
    clean, other = (masks.compose(masks.logits(raw), z, valid, paster) for z in (presence, rubbish))
    for one, two in zip(clean, other, strict=True):
        assert torch.equal(one, two)


@pytest.mark.parametrize("outside", ["zero", "minus_c"])
def test_apex_against_the_equations(outside: str) -> None:
    raw, presence, valid, windows = scene(K)
    c = 4.0
    out = ApexNormalisation(c, outside).compose(  # type: ignore[arg-type]
        ApexNormalisation(c).logits(raw), presence, valid, Paster(windows, G, SIZE)
    )
    for b in range(B):
        s = torch.zeros(SIZE, SIZE, dtype=torch.float64)
        exponentials = []
        for k in range(K):
            alpha = c * torch.tanh(raw[b, k])  # Eq. 7

            def warp(glimpse: torch.Tensor, b: int = b, k: int = k) -> torch.Tensor:
                return paste(glimpse[None, None], windows[b, k][None], SIZE)[0, 0]

            s += warp(torch.log(1 + alpha.exp()) * presence[b, k])  # Eq. 8
            warped = warp(alpha) - (0 if outside == "zero" else c * (1 - warp(torch.ones_like(alpha))))
            exponentials.append((warped + 2 * c * presence[b, k]).exp())  # Eq. 9
        m_fg = torch.tanh(s)
        m_hat = torch.stack(exponentials) / sum(exponentials)  # Eq. 10
        torch.testing.assert_close(out.foreground[b], m_fg)
        torch.testing.assert_close(out.objects[b], m_hat * m_fg)  # Eq. 11
        torch.testing.assert_close(out.background[b], 1 - m_fg)  # Eq. 12
        torch.testing.assert_close(out.log_background[b].exp(), 1 - m_fg)


def test_present_and_absent_logits_do_not_overlap() -> None:
    """Eq. 9: a present component outbids any component whose z_pres is zero, whatever their logits."""
    c = 5.0
    whole = torch.tensor([[1.0, 1.0, 0.0, 0.0]] * 2)[None]
    alpha = torch.stack([torch.full((G, G), -0.999 * c), torch.full((G, G), 0.999 * c)])[None]
    presence = torch.tensor([[1.0, 0.0]])
    out = ApexNormalisation(c).compose(alpha, presence, torch.ones(1, 2, dtype=torch.bool), Paster(whole, G, G))
    inner = (..., slice(1, -1), slice(1, -1))
    assert (out.log_objects[:, 0] > out.log_objects[:, 1])[inner].all()


def test_scalor_against_its_formula() -> None:
    raw, presence, valid, windows = scene(K)
    out = ScalorNormalisation().compose(torch.sigmoid(raw), presence, valid, Paster(windows, G, SIZE))
    warped = paste(torch.sigmoid(raw).reshape(-1, 1, G, G), windows.reshape(-1, 4), SIZE).reshape(B, K, SIZE, SIZE)
    warped = warped * presence[..., None, None]
    want = warped**2 / warped.sum(1, keepdim=True).clamp_min(1e-6)
    torch.testing.assert_close(out.objects, want)
    torch.testing.assert_close(out.background, 1 - want.sum(1).clamp(0, 1))
    # the scope of what was propagated, where windows overlap and where they do not, and a proposal's claim
    alone = ScalorNormalisation().foreground(torch.sigmoid(raw), presence, Paster(windows, G, SIZE))
    torch.testing.assert_close(alone, want.sum(1).clamp(0, 1))
    assert ((warped > 0).sum(1) > 1).any()
    claim = ScalorNormalisation().claim(torch.sigmoid(raw), Paster(windows, G, SIZE))
    torch.testing.assert_close(claim * presence[..., None, None], warped)


def test_claim_is_tanh_softplus_inside_the_window_only() -> None:
    raw, _, _, windows = scene(K)
    masks = ApexNormalisation()
    alpha = masks.logits(raw)
    claim = masks.claim(alpha, Paster(windows, G, SIZE))
    warped = paste(alpha.reshape(-1, 1, G, G), windows.reshape(-1, 4), SIZE).reshape(B, K, SIZE, SIZE)
    ones = paste(torch.ones_like(alpha).reshape(-1, 1, G, G), windows.reshape(-1, 4), SIZE).reshape_as(claim)
    torch.testing.assert_close(claim, torch.tanh(F.softplus(warped)) * ones)
    assert (claim[ones == 0] == 0).all()


@pytest.mark.parametrize("masks", [ApexNormalisation(), ScalorNormalisation()])
@pytest.mark.parametrize("present", [0, K])
@pytest.mark.parametrize("size", [0.018, 0.98])
def test_gradients_are_finite_at_the_extremes(masks: MaskNormalisation, present: int, size: float) -> None:
    raw, presence, valid, windows = scene(present, torch.float32)
    windows = torch.cat([torch.full_like(windows[..., :2], size), windows[..., 2:]], -1)
    leaves = [x.clone().requires_grad_() for x in (raw, presence, windows)]
    out = masks.compose(masks.logits(leaves[0]), leaves[1], valid, Paster(leaves[2], G, SIZE))
    finite = out.log_objects.masked_fill(out.log_objects == -torch.inf, 0.0)
    (finite.mean() + out.log_background.mean() + out.objects.mean()).backward()
    assert all(x.grad is None or x.grad.isfinite().all() for x in leaves)
    assert leaves[0].grad is not None


def test_a_claim_s_gradient_is_that_of_autograd() -> None:
    torch.manual_seed(0)
    alpha = torch.randn(2, 3, 8, 8, dtype=torch.float64, requires_grad=True)
    windows = torch.cat([torch.rand(2, 3, 2) * 0.6 + 0.2, torch.rand(2, 3, 2) - 0.5], dim=-1).double().requires_grad_()

    def plainly(alpha: torch.Tensor, windows: torch.Tensor) -> torch.Tensor:
        paster = Paster(windows, 8, 16)
        rows, columns = paster.inside()
        warped = paster.each(alpha[..., None, :, :]).squeeze(-3)
        return torch.tanh(torch.nn.functional.softplus(warped)) * (rows[..., :, None] * columns[..., None, :])

    def by_hand(alpha: torch.Tensor, windows: torch.Tensor) -> torch.Tensor:
        return ApexNormalisation().claim(alpha, Paster(windows, 8, 16))

    weights = torch.randn(2, 3, 16, 16, dtype=torch.float64)
    wanted, found = plainly(alpha, windows), by_hand(alpha, windows)
    torch.testing.assert_close(found, wanted)
    gradients = [torch.autograd.grad((claims * weights).sum(), (alpha, windows)) for claims in (wanted, found)]
    torch.testing.assert_close(gradients[1], gradients[0])


@pytest.mark.parametrize("masks", [ApexNormalisation(), ScalorNormalisation()])
def test_where_no_window_reaches_objects_weigh_exactly_nothing(masks: MaskNormalisation) -> None:
    window = torch.tensor([[[0.25, 0.25, -0.5, -0.5]]])
    there = torch.ones(1, 1, dtype=torch.bool)
    out = masks.compose(masks.logits(torch.ones(1, 1, G, G)), there.float(), there, Paster(window, G, SIZE))
    outside = paste(torch.ones(1, 1, G, G), window[0], SIZE)[:, 0] == 0
    assert outside.sum() > SIZE**2 / 2
    assert (out.objects[:, 0][outside] == 0).all()
    assert (out.log_objects[:, 0][outside] == -torch.inf).all()
    assert (out.log_background[outside] == 0).all()
    assert out.log_objects[:, 0][~outside].isfinite().all()
