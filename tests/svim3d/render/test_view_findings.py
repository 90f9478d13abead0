import pytest
import torch
from sphere_orbit import sphere_cameras, sphere_images

from svim3d.cameras import orbit_cameras
from svim3d.color import linear_from_srgb, srgb_from_linear
from svim3d.render.view_findings import colour_slopes, view_findings, widest_gap_deg


@pytest.fixture(scope="module")
def cameras():
    return sphere_cameras(views=12, size=48)


@pytest.fixture
def images(cameras):
    """A dull sphere under a light from above, whose two colours meet at all normals."""
    images = sphere_images(cameras)
    images["metallic"] = torch.zeros_like(images["mask"])
    normal = images["normal_world"]
    view, row, column = torch.meshgrid(*map(torch.arange, normal.shape[:3]), indexing="ij")
    patch = ((row // 3 + column // 3 + view) % 2)[..., None]
    colour = torch.where(patch == 0, 0.9, 0.45) * torch.tensor([1.0, 0.7, 0.5])
    images["basecolor"] = colour * images["mask"]
    # A little relief, so that no two pixels are equally bright.
    shading = 0.5 + 0.3 * normal[..., 1:2] + 0.1 * normal[..., :1]
    images["radiance"] = images["basecolor"] * shading
    return images


def kinds(cameras, images):
    return [kind for kind, _ in view_findings(cameras, images)]


def test_nothing_is_found_in_sound_views(cameras, images):
    assert kinds(cameras, images) == []


def test_few_and_one_sided_views_are_told(cameras, images):
    chosen = [0, 1, 2, 3, 4, 5, 6]
    assert widest_gap_deg(cameras) == pytest.approx(30.0, abs=1e-3)
    assert widest_gap_deg(cameras[chosen]) == pytest.approx(180.0, abs=1e-3)
    assert kinds(cameras[chosen], {n: i[chosen] for n, i in images.items()}) == ["few_views"]


def test_an_object_at_the_frame_is_told(images):
    near = orbit_cameras([(0.0, 30.0 * i) for i in range(12)], radius=1.3, fov_y_deg=33.8, size=48)
    assert "cut_off" in kinds(near, sphere_images(near))


def test_soft_masks_are_told(cameras, images):
    planes = images["mask"].permute(0, 3, 1, 2)
    soft = torch.nn.functional.avg_pool2d(planes, 9, 1, 4).permute(0, 2, 3, 1)
    assert "soft_masks" in kinds(cameras, images | {"mask": soft})


def test_clipped_highlights_are_told(cameras, images):
    limit = 0.6 * float(images["radiance"].max())
    assert kinds(cameras, images | {"radiance": images["radiance"].clamp_max(limit)}) == [
        "clipped_highlights"
    ]


def test_sparkles_are_told(cameras, images):
    spoilt = images["radiance"].clone()
    spoilt[3, 20, 20] = 5000.0
    (message,) = (m for k, m in view_findings(cameras, images | {"radiance": spoilt}))
    assert message.startswith("1 pixels are up to")


def test_darkness_and_mirrors_are_told(cameras, images):
    dark = {name: images[name] * 0.02 for name in ("basecolor", "radiance")}
    assert "dark_basecolor" in kinds(cameras, images | dark)
    chrome = {"metallic": images["mask"], "roughness": 0.05 * images["mask"]}
    assert "mirror_like" in kinds(cameras, images | chrome)


def test_what_all_views_graze_is_told(cameras, images):
    low = orbit_cameras([(8.0, 30.0 * i) for i in range(12)], radius=2.2, fov_y_deg=33.8, size=48)
    up = torch.zeros_like(images["normal_world"])
    up[..., 1] = images["mask"][..., 0]
    assert "grazing_views" in kinds(low, images | {"normal_world": up})


def test_radiance_goes_with_basecolor_where_both_are_linear(cameras, images):
    covered = images["mask"][..., 0] > 0.5
    least, most = colour_slopes(images, covered)
    # Normals of a bin differ a little, which is all that separates the bounds.
    assert least == pytest.approx(1.0, abs=0.05)
    assert most == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
    ("name", "curve", "word"),
    [
        ("basecolor", srgb_from_linear, "basecolor seems to be display-encoded"),
        ("basecolor", linear_from_srgb, "basecolor seems to be linearised twice"),
        ("radiance", srgb_from_linear, "radiance display-encoded"),
    ],
)
def test_wrong_transfer_curves_are_told(cameras, images, name, curve, word):
    found = dict(view_findings(cameras, images | {name: curve(images[name])}))
    assert word in found["colour_space"]


def test_one_colour_tells_nothing_of_curves(cameras, images):
    even = 0.5 * images["mask"].expand(-1, -1, -1, 3)
    images = images | {"basecolor": even, "radiance": even}
    assert colour_slopes(images, images["mask"][..., 0] > 0.5) is None


def test_empty_masks_are_nobodys_finding(cameras, images):
    assert view_findings(cameras, images | {"mask": torch.zeros_like(images["mask"])}) == []
