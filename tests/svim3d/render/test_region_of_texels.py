import pytest
import torch

from svim3d.cameras import orbit_cameras
from svim3d.mesh.source_mesh import SourceMaterial, SourceMesh, merge
from svim3d.render.pictures import render_gbuffer
from svim3d.render.regions import region_of_points, region_of_texels, resized_region

UV = torch.tensor([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])


def same(found, wanted):
    # The weights of bilinear lookups add up to one within rounding.
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-5)


def square(z=0.0, *, half=0.5, uv=UV, back=False, material=0):
    """A square that faces +z, or -z with `back`; its texture stands upright seen from +z."""
    corners = half * torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32)
    return SourceMesh(
        vertices=corners + torch.tensor([0.0, 0.0, z]),
        faces=faces[:, [0, 2, 1]] if back else faces,
        normals=torch.tensor([[0.0, 0, -1.0 if back else 1.0]]).repeat(4, 1),
        uv=uv,
        tangents=torch.zeros(4, 4),
        colors=torch.ones(4, 3),
        face_material=torch.full((2,), material, dtype=torch.int32),
        materials=(SourceMaterial(), SourceMaterial()),
    )


def camera(azimuth=0.0, size=128):
    return orbit_cameras([(0.0, azimuth)], radius=3.0, fov_y_deg=33.8, size=size)


def carried(mesh, region, cameras, *, size=(32, 32), material=0):
    return region_of_texels(mesh, material, size, region, render_gbuffer(mesh, cameras))


def test_a_half_of_the_picture_is_that_half_of_the_texture():
    region = torch.zeros(128, 128, 1)
    region[:, 64:] = 1.0
    found = carried(square(), region, camera())
    same(found[:, 16:], torch.ones(32, 16, 1))
    same(found[:, :16], torch.zeros(32, 16, 1))
    wide = carried(square(), region, camera(), size=(16, 32))
    assert wide.shape == (16, 32, 1)
    same(wide, found[::2])


def test_texels_behind_something_or_facing_away_are_not_touched():
    everything = torch.ones(128, 128, 1)
    hidden = merge([square(-0.2, half=0.4), square(0.2, material=1)])
    assert not carried(hidden, everything, camera()).any()
    assert carried(hidden, everything, camera(), material=1).all()
    assert not carried(square(back=True), everything, camera()).any()
    # The first lies behind the camera, on its axis.
    points = torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 0.0]])
    seen = render_gbuffer(square(), camera())
    assert region_of_points(points, everything, seen)[:, 0].tolist() == pytest.approx([0, 1])


@pytest.mark.parametrize("azimuth", [45.0, 60.0, 75.0])
@pytest.mark.parametrize("size", [256, 1024])
def test_tilted_surfaces_do_not_hide_themselves(azimuth, size):
    found = carried(square(), torch.ones(size, size, 1), camera(azimuth, size))
    same(found, torch.ones(32, 32, 1))


@pytest.mark.parametrize("order", [1, -1])
def test_of_places_that_share_a_texel_the_one_in_the_region_decides(order):
    everything = torch.ones(128, 128, 1)
    both = merge([square(0.1), square(-0.1, back=True)][::order])
    same(carried(both, everything, camera()), torch.ones(32, 32, 1))
    # Two halves that mirror each other in the texture, as artists like it; one is drawn on.
    left = square()
    mirrored = UV * torch.tensor([-1.0, 1.0]) + torch.tensor([1.0, 0.0])
    right = square(uv=mirrored)
    half, shift = torch.tensor([0.5, 1.0, 1.0]), torch.tensor([0.25, 0.0, 0.0])
    parts = [
        SourceMesh(**{**vars(part), "vertices": part.vertices * half + sign * shift})
        for part, sign in ((left, -1.0), (right, 1.0))
    ][::order]
    region = torch.zeros(128, 128, 1)
    region[:, :60] = 1.0
    found = carried(merge(parts), region, camera())
    assert found[:, :28].all()


def test_repeated_textures_are_met_in_every_tile():
    region = torch.zeros(128, 128, 1)
    region[:, 64:] = 1.0
    # A quarter of a texture to the right: the picture's right half lies in two tiles.
    found = carried(square(uv=UV + torch.tensor([0.25, -3.0])), region, camera())
    same(found[:, 24:], torch.ones(32, 8, 1))
    same(found[:, :8], torch.ones(32, 8, 1))
    same(found[:, 8:24], torch.zeros(32, 16, 1))


def test_regions_of_other_proportions_are_refused():
    assert resized_region(torch.ones(64, 64, 1), 128, 128).shape == (128, 128, 1)
    with pytest.raises(ValueError, match=r"proportions of 128 x 128 pixels, got 64 x 32"):
        resized_region(torch.ones(32, 64, 1), 128, 128)
