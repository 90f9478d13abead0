import pytest
import torch

from svim3d.cameras import orbit_angles, orbit_cameras
from svim3d.fields.sdf_grid import node_positions
from svim3d.mesh.cleanup import is_closed
from svim3d.mesh.marching import extract_surface
from svim3d.render.face_budget import (
    COARSER,
    CURVE_RATIO,
    UNSEEN,
    ShapeError,
    ShapePictures,
    decimate_to_error,
    face_counts,
)

RADIUS, MOST = 0.4, 8000
CAMERAS = orbit_cameras(orbit_angles(5, 10.0, 20.0), radius=2.2, fov_y_deg=33.8, size=64)


def surface(kind):
    """A sphere: smooth, with 12 x 5 knobs, or rough by noise of the grid."""
    x, y, z = node_positions(48, 0.55, like=torch.zeros(1)).unbind(-1)
    radius = RADIUS - torch.stack([x, y, z]).norm(dim=0)
    if kind == "knurled":
        radius = radius + 0.02 * torch.cos(12 * torch.atan2(x, z)) * torch.cos(30 * y)
    if kind == "rough":
        noise = torch.randn(radius.shape, generator=torch.Generator().manual_seed(0))
        radius = radius + 0.002 * noise
    return extract_surface(radius, 0.55)


def needed(kind, pictures=None, limit=UNSEEN):
    vertices, faces = surface(kind)
    pictures = pictures or ShapePictures.of_surface(vertices, faces, CAMERAS)
    return decimate_to_error(vertices, faces, pictures, limit=limit, max_faces=MOST)


def test_the_curve_descends_by_its_ratio():
    counts = face_counts(MOST)
    assert counts[0] == MOST
    assert counts[2] == MOST / 2
    assert 64 <= counts[-1] < 64 * CURVE_RATIO
    assert face_counts(50) == [50]


def test_a_surface_has_no_error_against_itself_and_a_smaller_one_that_of_its_area():
    vertices, faces = surface("smooth")
    pictures = ShapePictures.of_surface(vertices, faces, CAMERAS)
    assert pictures.error(vertices, faces).silhouette == 0.0
    assert pictures.error(vertices, faces).normal_deg < 1e-3
    # The outline's radius is R d / sqrt(d^2 - R^2): seen from 2.2, 0.9 R covers 0.80 of R's area.
    small = pictures.error(0.9 * vertices, faces)
    share = 0.81 * (2.2**2 - RADIUS**2) / (2.2**2 - 0.81 * RADIUS**2)
    assert small.silhouette == pytest.approx(1 - share, abs=0.01)
    assert pictures.error(vertices + 100.0, faces) == ShapeError(1.0, 180.0)


def test_a_sphere_needs_few_faces_and_knobs_need_more():
    smooth, knurled = needed("smooth"), needed("knurled")
    assert smooth.error.within(UNSEEN)
    assert len(smooth.mesh.faces) <= MOST / 2
    assert len(knurled.mesh.faces) >= 2 * len(smooth.mesh.faces)
    assert is_closed(smooth.mesh.faces)
    assert is_closed(knurled.mesh.faces)


def test_roughness_that_no_view_shows_keeps_no_faces():
    truth = surface("smooth")
    views = ShapePictures.of_surface(*truth, CAMERAS)
    seen = ShapePictures.of_views(CAMERAS, views.covered, views.normals)
    assert len(needed("rough", seen).mesh.faces) <= MOST / 2
    assert len(needed("rough").mesh.faces) == MOST  # held against itself, every bump counts


def test_larger_errors_give_fewer_faces():
    counts = [len(needed("smooth", limit=limit).mesh.faces) for limit in (UNSEEN, *COARSER)]
    assert counts == sorted(counts, reverse=True)
    assert len(set(counts)) == 4
