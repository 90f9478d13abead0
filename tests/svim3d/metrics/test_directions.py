import pytest
import torch

from svim3d.metrics.directions import angular_error, mean_angle_deg


@pytest.mark.parametrize("angle_deg", [0.0, 1e-4, 1.0, 90.0, 179.999, 180.0])
def test_mean_angle_is_exact_at_all_angles_and_any_length(angle_deg):
    a = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    angle = torch.tensor(angle_deg, dtype=torch.float64).deg2rad()
    b = 3.0 * torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)])[None]
    assert mean_angle_deg(a, b, torch.tensor([[True]])) == pytest.approx(angle_deg, abs=1e-9)


def test_uncovered_pixels_count_as_a_right_angle():
    a, b = torch.eye(3), torch.eye(3)
    b[2] = 0
    assert mean_angle_deg(a, b, torch.ones(3, 1, dtype=torch.bool)) == pytest.approx(30.0)


def test_shares_and_median_of_known_angles():
    angles = torch.tensor([0.0, 11.2, 11.3, 22.0, 29.0, 31.0, 80.0, 170.0]).deg2rad()
    a = torch.tensor([1.0, 0.0, 0.0]).expand(8, 3)
    b = torch.stack([angles.cos(), angles.sin(), torch.zeros(8)], -1)
    found = angular_error(a, b, torch.ones(8, 1, dtype=torch.bool))
    assert found.within == {11.25: 2 / 8, 22.5: 4 / 8, 30.0: 5 / 8}
    assert found.median_deg == pytest.approx((22.0 + 29.0) / 2, abs=1e-5)
    assert found.mean_deg == pytest.approx(float(angles.rad2deg().mean()), abs=1e-5)


def test_mask_chooses_the_pixels():
    a = torch.eye(3)
    b = torch.tensor([[1.0, 0, 0], [1, 0, 0], [0, 0, -1]])
    mask = torch.tensor([[True], [True], [False]])
    assert angular_error(a, b, mask).mean_deg == pytest.approx(45.0)
    with pytest.raises(ValueError, match="at least one pixel"):
        angular_error(a, b, mask & False)
