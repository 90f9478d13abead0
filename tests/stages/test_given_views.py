"""Fewer and smaller views of an orbit, and its photo."""

import json

import pytest
import torch

from stages.errors import InputError
from stages.given_views import given_views, photo_of, spread_views
from svim3d.cameras import orbit_angles, orbit_cameras
from svim3d.io.orbit import read_orbit, write_orbit

VIEWS = 6


@pytest.fixture
def orbit(tmp_path):
    """Six views of 8 px, each of one grey; the third is the reference."""
    cameras = orbit_cameras(orbit_angles(VIEWS, 10.0, 20.0), radius=2.0, fov_y_deg=30.0, size=8)
    grey = (torch.arange(VIEWS) / VIEWS).view(-1, 1, 1, 1).expand(-1, 8, 8, -1)
    images = {
        "radiance": grey.expand(-1, -1, -1, 3),
        "mask": torch.ones(VIEWS, 8, 8, 1),
        "basecolor": grey.expand(-1, -1, -1, 3),
        "roughness": grey,
        "metallic": grey,
        "normal_world": torch.tensor([0.0, 0.0, 1.0]).expand(VIEWS, 8, 8, 3),
        "depth": torch.ones(VIEWS, 8, 8, 1),
    }
    write_orbit(tmp_path / "thing", cameras, images, reference=2)
    return tmp_path / "thing"


@pytest.mark.parametrize(
    ("count", "reference", "wanted", "views"),
    [(6, 5, 6, [0, 1, 2, 3, 4, 5]), (6, 5, 3, [1, 3, 5]), (6, 2, 3, [4, 0, 2]), (21, 20, 4, None)],
)
def test_views_are_spread_evenly_and_end_at_the_reference(count, reference, wanted, views):
    found = spread_views(count, reference, wanted)
    assert views is None or found == views
    assert found[-1] == reference and len(set(found)) == wanted
    around = [(f - reference) % count or count for f in found]
    gaps = [b - a for a, b in zip([0, *around], around, strict=False)]
    assert max(gaps) - min(gaps) <= 1


def test_an_orbit_as_it_is_stays_where_it_is(orbit, tmp_path):
    assert given_views(orbit, tmp_path / "made", views=None, size=None) == orbit
    assert not (tmp_path / "made").exists()


def test_fewer_smaller_views_keep_their_cameras_and_values(orbit, tmp_path):
    folder = given_views(orbit, tmp_path / "made", views=3, size=4)
    assert given_views(orbit, tmp_path / "made", views=3, size=4) == folder
    whole, shown, _ = read_orbit(orbit)
    cameras, images, reference = read_orbit(folder)
    chosen = [4, 0, 2]
    assert (len(cameras), cameras.height, cameras.width, reference) == (3, 4, 4, 2)
    assert torch.equal(cameras.c2w, whole.c2w[chosen])
    assert "depth" not in images
    assert torch.allclose(images["radiance"][:, 0, 0], shown["radiance"][chosen, 0, 0], atol=1e-3)
    assert list((tmp_path / "made").iterdir()) == [folder]  # nothing half made is left


@pytest.mark.parametrize("views", [2, 7])
def test_too_few_or_too_many_views_are_refused(orbit, tmp_path, views):
    with pytest.raises(InputError, match=rf"wanted 3 to 6 views of .*, got {views}"):
        given_views(orbit, tmp_path / "made", views=views, size=None)


def test_a_photo_is_found_with_its_elevation(orbit):
    with pytest.raises(InputError, match="leave out --photos"):
        photo_of(orbit)
    index = json.loads((orbit / "orbit.json").read_text())
    index["train"] = [{"elevation_deg": 7.5}]
    index["reference"] = {"file": "reference.png", "train_index": 0}
    (orbit / "orbit.json").write_text(json.dumps(index))
    with pytest.raises(InputError, match="does not exist"):
        photo_of(orbit)
    (orbit / "reference.png").touch()
    assert photo_of(orbit) == (orbit / "reference.png", ("generation.elevation_deg=7.5",))
