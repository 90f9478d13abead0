"""The rules laid beside a second writing of them: plain numpy and scipy, one pixel rule a line."""

import math

import numpy as np
import pytest
import torch
from scipy import ndimage

from svim3d.metrics.captures import score_benchmark, score_capture, spread
from svim3d.metrics.stanford_orb import (
    compare_albedo,
    compare_pictures,
    depth_error,
    eroded,
    normal_error,
    shape_error,
)

SIZE = 24


def draw(seed: int, peak: float = 1.0) -> np.ndarray:
    return np.random.default_rng(seed).random((SIZE, SIZE, 3)) ** 2 * peak


def disc() -> np.ndarray:
    """A mask that touches the left border."""
    y, x = np.mgrid[:SIZE, :SIZE]
    return (y - 11.0) ** 2 + (x - 6.0) ** 2 < 81


def erode(mask: np.ndarray) -> np.ndarray:
    # What lies beyond the border does not erode.
    return ndimage.binary_erosion(mask, np.ones((5, 5)), border_value=1)


def srgb(x: np.ndarray) -> np.ndarray:
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)


def window_mean(x: np.ndarray) -> np.ndarray:
    g = np.exp(-0.5 * (np.array([-1.0, 0.0, 1.0]) / 1.5) ** 2)
    g /= g.sum()
    for axis in (0, 1):
        x = ndimage.convolve1d(x, g, axis=axis, mode="mirror")
    return x


def ssim_map(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    c1, c2 = 0.01**2, 0.03**2
    ma, mb = window_mean(a), window_mean(b)
    va, vb = window_mean(a * a) - ma * ma, window_mean(b * b) - mb * mb
    cab = window_mean(a * b) - ma * mb
    return (2 * ma * mb + c1) * (2 * cab + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2))


def official(prediction, truth, mask, *, scaled, albedo=False) -> dict:
    """A picture's official figures by the script's rules."""
    inside = erode(mask)[..., None].astype(float)
    figures = {}
    for name, peak in (("psnr_hdr_db", 4.0), ("psnr_ldr_db", 1.0)):
        p, g = prediction * inside, truth * inside
        if name == "psnr_hdr_db":
            clipped = np.clip(g, 0, 1)
            factor = srgb(clipped).mean() / clipped.mean()
            p, g = p * factor, g * factor
        if scaled:
            p = p * ((p * g).sum((0, 1)) / (p * p).sum((0, 1)))
        p, g = np.clip(p, 0, peak), np.clip(g, 0, peak)
        if name == "psnr_ldr_db" and not albedo:
            p, g = srgb(p), srgb(g)
        floor = ((0.5 * inside - g) ** 2).mean()
        figures[name] = -10 * math.log10(min(((p - g) ** 2).mean(), floor))
    figures["ssim"] = ssim_map(p, g).mean()
    figures["pair"] = p, g
    return figures


def tensors(*arrays: np.ndarray) -> list[torch.Tensor]:
    return [torch.from_numpy(np.ascontiguousarray(a)) for a in arrays]


def compare(prediction, truth, mask, **options):
    p, g, m = tensors(prediction, truth, mask[..., None])
    return compare_pictures(p, g, m, **options)


@pytest.mark.parametrize("scaled", [True, False])
def test_pictures_score_as_by_the_second_writing(scaled):
    truth, noise = draw(0, 3.0), draw(1, 0.6)
    prediction = truth * [0.8, 1.1, 1.3] + noise
    found = compare(prediction, truth, disc(), scaled=scaled).rows["official"]
    expected = official(prediction, truth, disc(), scaled=scaled)
    for name in ("psnr_hdr_db", "psnr_ldr_db", "ssim"):
        assert found[name] == pytest.approx(expected[name], rel=1e-9), name


def test_albedo_stays_linear():
    truth = draw(0)
    prediction = 0.5 * truth + 0.05 * draw(1)
    p, g, m = tensors(prediction, truth, disc()[..., None])
    found = compare_albedo(p, g, m).rows["official"]
    expected = official(prediction, truth, disc(), scaled=True, albedo=True)
    assert found["psnr_ldr_db"] == pytest.approx(expected["psnr_ldr_db"], rel=1e-9)
    assert found["ssim"] == pytest.approx(expected["ssim"], rel=1e-9)
    assert "psnr_hdr_db" not in found


def test_foreground_row_lacks_the_black_around():
    truth = draw(0)
    rows = compare(truth + 0.1, truth, disc(), scaled=False).rows
    share = erode(disc()).mean()
    for name in ("psnr_hdr_db", "psnr_ldr_db"):
        gain = rows["official"][name] - rows["foreground"][name]
        assert gain == pytest.approx(-10 * math.log10(share), rel=1e-9)
    # No scale was fitted, so that the third row is the first one.
    assert rows["unscaled"] == rows["official"]


def test_scale_is_forgiven_per_channel_and_only_where_it_is_fitted():
    truth = draw(0)
    rows = compare(truth * [0.5, 1.0, 2.0], truth, disc(), scaled=True).rows
    assert rows["official"]["psnr_hdr_db"] > 200
    assert rows["unscaled"]["psnr_hdr_db"] < 30


def test_no_picture_is_worse_than_grey_inside_the_mask():
    truth = np.full((SIZE, SIZE, 3), 0.25)
    found = compare(np.full_like(truth, 4.0), truth, disc(), scaled=False).rows["official"]
    grey = (0.5 - srgb(np.array(0.25))) ** 2 * erode(disc()).mean()
    assert found["psnr_ldr_db"] == pytest.approx(-10 * math.log10(grey), rel=1e-9)


def test_missing_picture_is_a_white_one_and_is_counted():
    truth = draw(0)
    p, g, m = tensors(np.ones_like(truth), truth, disc()[..., None])
    missing = compare_pictures(None, g, m, scaled=True)
    assert missing.rows == compare_pictures(p, g, m, scaled=True).rows
    assert missing.is_missing


def test_lpips_sees_curve_and_mask_twice_applied():
    truth, prediction = draw(0), draw(1)
    seen = []

    def distance(a, b):
        seen.append((a, b))
        return (a - b).abs().mean()

    rows = compare(prediction, truth, disc(), scaled=True, lpips=distance).rows
    assert "lpips" in rows["official"] and "lpips" in rows["unscaled"]
    assert "lpips" not in rows["foreground"]
    pair = official(prediction, truth, disc(), scaled=True)["pair"]
    for found, expected in zip(seen[0], pair, strict=True):
        np.testing.assert_allclose(found[0].numpy(), srgb(expected), atol=1e-6)


def test_black_prediction_stays_black():
    truth = draw(0)
    found = compare(np.zeros_like(truth), truth, disc(), scaled=True).rows["foreground"]
    g = srgb(truth[erode(disc())])
    floor = min((g**2).mean(), ((g - 0.5) ** 2).mean())
    assert found["psnr_ldr_db"] == pytest.approx(-10 * math.log10(floor), rel=1e-9)


def test_nearly_black_channels_are_scaled_as_if_they_were_one():
    truth, faint = draw(0, 0.1), 3e-5
    found = compare(np.full_like(truth, faint), truth, disc(), scaled=True).rows["foreground"]
    g = truth[erode(disc())]
    squared = ((srgb(faint * g.mean(0)) - srgb(g)) ** 2).mean()
    floor = ((0.5 - srgb(g)) ** 2).mean()
    assert found["psnr_ldr_db"] == pytest.approx(-10 * math.log10(min(squared, floor)), rel=1e-9)
    assert squared < floor


def test_negative_truth_counts_as_black():
    truth = draw(0, 0.1)
    truth[11, 6] = 0.0
    spoilt = truth.copy()
    spoilt[11, 6] = -5.0
    prediction = draw(1, 0.1)
    expected = compare(prediction, truth, disc(), scaled=True)
    assert compare(prediction, spoilt, disc(), scaled=True) == expected


@pytest.mark.parametrize("bad", [-0.1, math.nan, math.inf])
def test_impossible_radiance_is_refused(bad):
    truth = draw(0)
    prediction = truth.copy()
    prediction[11, 6] = bad
    with pytest.raises(ValueError, match="finite linear values"):
        compare(prediction, truth, disc(), scaled=True)


def test_an_object_that_erodes_away_is_refused():
    with pytest.raises(ValueError, match="5 x 5"):
        compare(draw(0), draw(0), np.eye(SIZE, dtype=bool), scaled=True)


def test_erosion_is_scipys():
    mask = np.random.default_rng(0).random((SIZE, SIZE)) > 0.03
    (tensor,) = tensors(mask[..., None])
    np.testing.assert_array_equal(eroded(tensor)[..., 0].numpy(), erode(mask))


def test_normals_of_known_tilt():
    angle = math.radians(25.0)
    truth = torch.tensor([0.0, 0, 1]).expand(SIZE, SIZE, 3)
    tilted = 2.0 * torch.tensor([math.sin(angle), 0, math.cos(angle)]).expand(SIZE, SIZE, 3)
    (mask,) = tensors(disc()[..., None])
    assert normal_error(tilted, truth, mask) == pytest.approx(1 - math.cos(angle), abs=1e-5)
    assert normal_error(None, truth, mask) == 1.0


def test_depth_has_one_scale_for_all_views():
    (mask,) = tensors(disc()[..., None])
    near, far = torch.full((SIZE, SIZE, 1), 1.0), torch.full((SIZE, SIZE, 1), 2.0)
    assert depth_error([3 * near, 3 * far], [near, far], [mask, mask]) == pytest.approx(0, abs=1e-9)
    # Depths 1 and 1 for 1 and 2: the scale is 1.5, both are half off.
    share = erode(disc()).mean()
    found = depth_error([near, near], [near, far], [mask, mask])
    assert found == pytest.approx(1e3 * 0.25 * share, rel=1e-9)
    # Nothing predicted counts as a constant.
    assert depth_error([0 * near, near], [near, far], [mask, mask]) == pytest.approx(found)


def test_shape_is_squared_and_in_the_tables_unit():
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    faces = torch.tensor([[0, 1, 2]])
    scan = torch.rand(20_000, 2, generator=torch.Generator().manual_seed(1))
    scan = torch.where(scan.sum(1, keepdim=True) > 1, 1 - scan, scan)
    lifted = torch.cat([scan, torch.full((20_000, 1), 0.1)], 1)
    found = shape_error((corners, faces), lifted, torch.Generator().manual_seed(0))
    assert found == pytest.approx(2e3 * 0.01, rel=0.01)
    # A missing mesh is a point in the origin: the mean square of the scan, both ways.
    squares = lifted.double().square().sum(1)
    expected = 1e3 * float(squares.mean() + squares.min())
    generator = torch.Generator()
    assert shape_error(None, lifted, generator) == pytest.approx(expected, rel=1e-6)


def test_captures_count_alike_however_many_pictures_they_have():
    good, bad = draw(0), draw(1)
    p, q, m = tensors(good, bad, disc()[..., None])
    fine = compare_pictures(p + 0.05, p, m, scaled=True)
    poor = compare_pictures(q, p, m, scaled=True)
    lost = compare_pictures(None, p, m, scaled=True)
    one = score_capture("one", [fine, fine, poor, lost])
    two = score_capture("two", [lost])
    table = score_benchmark([one, two])
    values = [c.rows["official"]["psnr_hdr_db"] for c in (one, two)]
    told = table.rows["official"]["psnr_hdr_db"]
    assert told.mean == pytest.approx(np.mean(values))
    assert told.std == pytest.approx(np.std(values))
    assert told.worst == min(values)
    assert told.worst_capture == ("one", "two")[int(np.argmin(values))]
    assert (table.pictures, table.missing, table.failed_captures) == (5, 2, ("two",))


def test_spread_tells_the_bad_side():
    values = {str(i): float(i) for i in range(11)}
    high, low = (spread(values, is_better_high=side) for side in (True, False))
    assert (high.p10, high.worst, high.worst_capture) == (1.0, 0.0, "0")
    assert (low.p10, low.worst, low.worst_capture) == (9.0, 10.0, "10")
    assert spread({"a": 1.0, "b": math.nan}, is_better_high=True).captures == 1
    with pytest.raises(ValueError, match="at least one"):
        spread({"a": math.nan}, is_better_high=True)
