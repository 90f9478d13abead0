import pytest
import torch

from svim3d.shading.tonemap import INSET, OUTSET, agx, expose, linear_from_agx


@pytest.mark.parametrize(("grey", "encoded"), [(0.18, 0.500), (1.0, 0.7875), (16.0, 0.9995)])
def test_greys(grey, encoded):
    # The polynomial is within 0.006 of the original table, whose values these are.
    found = agx(torch.full((1, 3), grey, dtype=torch.float64))
    torch.testing.assert_close(
        found, torch.full((1, 3), encoded, dtype=torch.float64), rtol=0, atol=0.006
    )


def test_grey_stays_grey_and_outset_undoes_the_inset():
    encoded = agx(torch.logspace(-4, 2, 50, dtype=torch.float64)[:, None].expand(-1, 3))
    assert float((encoded.amax(-1) - encoded.amin(-1)).max()) < 1e-3
    product = torch.tensor(OUTSET, dtype=torch.float64) @ torch.tensor(INSET, dtype=torch.float64)
    torch.testing.assert_close(product, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-6)


def test_brightness_never_turns_back():
    encoded = agx(torch.logspace(-5, 3, 400, dtype=torch.float64)[:, None].expand(-1, 3))[:, 0]
    assert float(encoded.diff().min()) >= -2e-3
    assert float(encoded.min()) >= 0.0
    assert float(encoded.max()) <= 1.0


def test_black_and_negative_light_have_finite_gradients():
    radiance = torch.tensor([[0.0, -1.0, 1e-9], [0.5, 0.2, 100.0]], requires_grad=True)
    agx(radiance).sum().backward()
    assert bool(torch.isfinite(radiance.grad).all())


def test_exposure_and_display_power():
    radiance = torch.rand(5, 3)
    torch.testing.assert_close(expose(radiance, 2.0), 4.0 * radiance)
    torch.testing.assert_close(linear_from_agx(torch.full((3,), 0.5)), torch.full((3,), 0.5**2.2))
