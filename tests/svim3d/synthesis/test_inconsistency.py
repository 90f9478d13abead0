from dataclasses import asdict, replace

import pytest
import torch
from sphere_orbit import sphere_cameras, sphere_images

from svim3d.synthesis.displacements import (
    largest_displacement_px,
    pixel_centres,
    resample,
    transformed,
)
from svim3d.synthesis.inconsistency import (
    KINDS,
    WORST,
    Strengths,
    make_inconsistent,
)

VIEWS, SIZE = 5, 64
REFERENCE = 2


@pytest.fixture(scope="module")
def cameras():
    return sphere_cameras(VIEWS, SIZE)


@pytest.fixture(scope="module")
def images(cameras):
    """A sphere with a pattern of its own in each picture, and the optional planes."""
    made = sphere_images(cameras)
    row, column = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    wave = 0.5 + 0.25 * (torch.sin(0.5 * row) + torch.sin(0.45 * column + 0.2 * row))
    made["basecolor"] = (made["basecolor"] * wave[..., None]).half().float()
    made["roughness"] = (made["mask"] * wave[..., None]).half().float()
    made["radiance"] = (made["radiance"] * (0.2 + 2.0 * wave[..., None])).half().float()
    made["depth"] = 2.0 * made["mask"]
    made["confidence"] = 0.5 * made["mask"]
    return made


def corrupt(cameras, images, strengths, seed=0):
    return make_inconsistent(cameras, images, REFERENCE, strengths, seed)


def others(image):
    return image[[v for v in range(VIEWS) if v != REFERENCE]]


def test_severity_zero_is_the_identity_to_the_bit(cameras, images):
    result = corrupt(cameras, images, Strengths.at(0.0))
    assert result.images.keys() == images.keys()
    for name, image in images.items():
        assert torch.equal(result.images[name], image), name
    assert torch.equal(result.homography, torch.eye(3).expand(VIEWS, 3, 3))


def test_the_same_seed_repeats_and_another_differs(cameras, images):
    first, again = (corrupt(cameras, images, Strengths.at(3.0), seed=4) for _ in range(2))
    other = corrupt(cameras, images, Strengths.at(3.0), seed=5)
    assert torch.equal(first.homography, again.homography)
    for name in images:
        assert torch.equal(first.images[name], again.images[name])
        assert not torch.equal(first.images[name], other.images[name])


@pytest.mark.parametrize("kind", KINDS)
def test_the_reference_stays_and_every_other_view_changes(cameras, images, kind):
    result = corrupt(cameras, images, Strengths.at(5.0).only(kind))
    for name, image in images.items():
        assert torch.equal(result.images[name][REFERENCE], image[REFERENCE])
    assert torch.equal(result.homography[REFERENCE], torch.eye(3))
    touched = torch.zeros(VIEWS, dtype=torch.bool)
    for name, image in images.items():
        touched |= (result.images[name] != image).flatten(1).any(1)
    assert touched.tolist() == [view != REFERENCE for view in range(VIEWS)]


MOVES = {"homography_px", "smooth_warp_px", "outline_px"}
CHANGES = {
    "blur_px": {"radiance", "basecolor", "roughness", "metallic", "normal_world"},
    "colour_stops": {"radiance", "basecolor"},
    "baked_light": {"basecolor"},
    "normal_deg": {"normal_world"},
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_kind_changes_its_own_images_alone(cameras, images, kind):
    result = corrupt(cameras, images, Strengths.at(4.0).only(kind))
    expected = set(images) if kind in MOVES else CHANGES[kind]
    assert {n for n, i in images.items() if not torch.equal(result.images[n], i)} == expected


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_grows_with_severity(cameras, images, kind):
    name = {"outline_px": "mask", "normal_deg": "normal_world"}.get(kind, "basecolor")

    def error(severity):
        changed = corrupt(cameras, images, Strengths.at(severity).only(kind)).images
        both = (others(changed["mask"]) > 0.5) & (others(images["mask"]) > 0.5)
        mask = torch.ones_like(both) if name == "mask" else both
        difference = (others(changed[name]) - others(images[name])).square()
        return float((difference * mask).mean() / mask.float().mean())

    errors = [error(severity) for severity in (2.0, 3.0, 4.0, 5.0)]
    assert errors == sorted(errors)
    assert errors[-1] > 2.0 * errors[0] > 0.0


def test_displacements_are_those_of_the_homographies_and_bounded(cameras, images):
    reach = []
    for severity in (1.0, 5.0):
        result = corrupt(cameras, images, Strengths.at(severity))
        for view, homography in enumerate(result.homography):
            if view != REFERENCE:
                moved = largest_displacement_px(homography, images["mask"][view])
                reach.append(moved / (8.0 * severity / WORST))
    assert min(reach) >= 0.49
    assert max(reach) <= 1.01


def test_the_true_homography_brings_the_picture_back(cameras, images):
    row, column = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    wave = (0.5 + 0.25 * (torch.sin(0.3 * row) + torch.sin(0.4 * column + 0.1 * row)))[..., None]
    wavy = images | {"radiance": images["mask"] * wave.expand(-1, -1, 3)}
    result = corrupt(cameras, wavy, Strengths.at(5.0).only("homography_px"))
    centres = pixel_centres((SIZE, SIZE), images["mask"])
    # Well inside the outline, which is a step that no resampling brings back.
    inner = -torch.nn.functional.max_pool2d(-images["mask"].movedim(-1, 1), 9, 1, 4).movedim(1, -1)
    for view in range(VIEWS):
        true, moved = (i["radiance"][view] for i in (wavy, result.images))
        # The displaced picture, read where each true point went.
        back = resample(moved, transformed(result.homography[view], centres))
        before, after = (float(((x - true) * inner[view]).square().mean()) for x in (moved, back))
        assert after < 0.05 * before or view == REFERENCE
        assert after < 1e-9 or view != REFERENCE


def test_drift_and_blur_grow_away_from_the_reference(cameras, images):
    apart = -(cameras.positions @ cameras.positions[REFERENCE])
    nearest, farthest = int(apart.argsort()[1]), int(apart.argmax())
    for kind in ("blur_px", "colour_stops"):
        change = torch.zeros(VIEWS)
        for seed in range(8):
            changed = corrupt(cameras, images, Strengths.at(5.0).only(kind), seed).images
            change += (changed["radiance"] - images["radiance"]).abs().mean((1, 2, 3))
        assert float(change[farthest]) > 1.3 * float(change[nearest]) > 0.0


def test_drift_grows_towards_grazing_angles(cameras, images):
    apart = -(cameras.positions @ cameras.positions[REFERENCE])
    view = int(apart.argmax())
    wo = -cameras.rays(view)[1].view(SIZE, SIZE, 3)
    cosine = (wo * images["normal_world"][view]).sum(-1)
    frontal, grazing = cosine > 0.9, (cosine > 0.0) & (cosine < 0.4)
    stops = torch.zeros(2)
    for seed in range(12):
        strengths = Strengths.at(5.0).only("colour_stops")
        changed = corrupt(cameras, images, strengths, seed).images["radiance"][view]
        ratio = (changed / images["radiance"][view]).log2().abs()
        stops += torch.stack([ratio[frontal].mean(), ratio[grazing].mean()])
    assert float(stops[1]) > 1.2 * float(stops[0]) > 0.0


def test_images_stay_valid(cameras, images):
    result = corrupt(cameras, images, Strengths.at(5.0)).images
    covered = result["mask"] > 0.0
    assert float(result["mask"].max()) <= 1.0
    for name in ("basecolor", "roughness", "metallic"):
        assert float(result[name].min()) >= 0.0
        assert float(result[name].max()) <= 1.0 + 1e-6
    assert float(result["radiance"].min()) >= 0.0
    length = torch.linalg.vector_norm(result["normal_world"], dim=-1, keepdim=True)
    # The reference keeps the rounding of the half floats that it came in.
    assert torch.allclose(length[covered], torch.ones(int(covered.sum())), atol=1e-3)
    unit = others(length)[others(covered)]
    assert torch.allclose(unit, torch.ones_like(unit), atol=1e-5)
    for name, image in result.items():
        assert bool(torch.isfinite(image).all()), name
        assert float((image * ~covered).abs().max()) == 0.0, name


def test_premultiplied_radiance_keeps_its_straight_colour(cameras, images):
    # An evenly bright object: whatever moves, its straight radiance must stay what it is.
    even = images | {"radiance": 0.8 * images["mask"].expand(-1, -1, -1, 3).contiguous()}
    strengths = Strengths.at(5.0).only(*MOVES, "blur_px")
    result = corrupt(cameras, even, strengths).images
    covered = result["mask"] > 0.01
    straight = (result["radiance"] / result["mask"].clamp_min(1e-6))[covered[..., 0]]
    assert torch.allclose(straight, torch.full_like(straight, 0.8), atol=1e-3)
    partial = (result["mask"] > 0.05) & (result["mask"] < 0.95)
    assert int(partial.sum()) > 50


def test_one_kind_alone_is_that_of_the_mixture(cameras, images):
    alone = corrupt(cameras, images, Strengths.at(3.0).only("homography_px"))
    mixed = corrupt(cameras, images, Strengths.at(3.0))
    assert torch.equal(alone.homography, mixed.homography)


def test_an_empty_view_is_left_as_it_is(cameras, images):
    empty = {name: image.clone() for name, image in images.items()}
    for image in empty.values():
        image[0] = 0.0
    result = corrupt(cameras, empty, Strengths.at(5.0))
    assert all(torch.equal(result.images[n][0], empty[n][0]) for n in empty)


def test_strengths_are_checked():
    assert asdict(Strengths.at(5.0))["homography_px"] == 8.0
    assert Strengths.at(2.5) == Strengths(
        **{n: v / 2 for n, v in asdict(Strengths.at(5.0)).items()}
    )
    for wrong in (-0.1, 5.1, float("nan")):
        with pytest.raises(ValueError, match="severity from 0 to 5"):
            Strengths.at(wrong)
    with pytest.raises(ValueError, match="baked_light from 0 to 1"):
        Strengths(baked_light=1.5)
    with pytest.raises(ValueError, match="blur_px"):
        replace(Strengths(), blur_px=-1.0)
    with pytest.raises(ValueError, match="wanted kinds among homography_px"):
        Strengths().only("fog")
