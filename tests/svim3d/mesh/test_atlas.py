import math
import signal
import subprocess
import sys

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from svim3d.fields.sdf_grid import node_positions
from svim3d.mesh import xatlas_process
from svim3d.mesh.atlas import unwrap, unwrap_boxes, unwrap_charts
from svim3d.mesh.marching import extract_surface
from svim3d.mesh.mesh import face_normals_scaled
from svim3d.mesh.texels import rasterize_uv

SIZE, GUTTER = 128, 4


@pytest.fixture(scope="module")
def bumpy():
    points = node_positions(20, 0.55, like=torch.zeros(1))
    radius = 0.35 + 0.05 * torch.sin(14 * points).prod(-1)
    return extract_surface(radius - points.norm(dim=-1), 0.55)


def by_xatlas(vertices, faces, **options):
    return unwrap_charts(vertices, faces, timeout_s=120.0, **options)


def by_boxes(vertices, faces, **options):
    return unwrap_boxes(vertices, faces, reason="test", **options)


@pytest.mark.parametrize("method", [by_xatlas, by_boxes])
def test_atlas_covers_every_face_once(bumpy, method):
    vertices, faces = bumpy
    atlas = method(vertices, faces, texture_size=SIZE, gutter_px=GUTTER)
    assert torch.equal(atlas.vertex_source[atlas.faces.long()], faces.long())
    assert atlas.uv.min() >= 0
    assert atlas.uv.max() <= 1
    assert atlas.texels.overlaps == 0
    assert rasterize_uv(atlas.uv, atlas.faces, SIZE).overlaps == 0
    assert rasterize_uv(atlas.uv, atlas.faces, 8 * SIZE).overlaps <= 8  # rounding along folds
    assert len(atlas.texels.pixel) / SIZE**2 > 0.35
    # Every face has room in proportion to its area.
    corner = atlas.uv[atlas.faces.long()].double()
    edge_a, edge_b = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    room = (edge_a[:, 0] * edge_b[:, 1] - edge_a[:, 1] * edge_b[:, 0]).abs()
    area = face_normals_scaled(vertices, faces).double().norm(dim=1)
    low, high = (room / area)[area > area.median()].quantile(torch.tensor([0.01, 0.99]).double())
    assert high / low < 5


@pytest.mark.parametrize("method", [by_xatlas, by_boxes])
def test_charts_keep_the_gutter(bumpy, method):
    atlas = method(*bumpy, texture_size=SIZE, gutter_px=GUTTER)
    chart = chart_of_vertices(atlas)
    scale = 4
    texels = rasterize_uv(atlas.uv, atlas.faces, scale * SIZE)
    owner = np.full((scale * SIZE) ** 2, -1)
    owner[texels.pixel] = chart[atlas.faces[texels.face, 0].long()]
    owner = owner.reshape(scale * SIZE, -1)
    nearest = min(
        distance_transform_edt(owner != index)[(owner >= 0) & (owner != index)].min()
        for index in range(min(atlas.charts, 4))
    )
    assert nearest / scale >= GUTTER - 3.5 / scale  # each border is drawn up to 0.75 texel wide


def chart_of_vertices(atlas):
    faces = atlas.faces.long().numpy()
    rows, columns = faces[:, [0, 1, 2]].reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    count = len(atlas.uv)
    links = coo_array((np.ones(len(rows), bool), (rows, columns)), shape=(count, count))
    return connected_components(links, directed=False)[1]


def test_box_charts_keep_their_handedness(bumpy):
    atlas = by_boxes(*bumpy, texture_size=SIZE, gutter_px=GUTTER)
    corner = atlas.uv[atlas.faces.long()].double() * torch.tensor([1.0, -1.0])
    edge_a, edge_b = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    signed = edge_a[:, 0] * edge_b[:, 1] - edge_a[:, 1] * edge_b[:, 0]
    assert (signed > -1e-12).float().mean() > 0.999


def helix(turns=3, steps=60):
    """A spiral staircase: seen along its axis it covers itself `turns` times."""
    angle = torch.linspace(0, 2 * math.pi * turns, steps)
    inner, outer = (
        torch.stack([r * angle.cos(), 0.02 * angle, r * angle.sin()], -1) for r in (0.2, 0.5)
    )
    vertices = torch.stack([inner, outer], 1).reshape(-1, 3)
    index = 2 * torch.arange(steps - 1)[:, None]
    first, second = index + torch.tensor([0, 2, 1]), index + torch.tensor([1, 2, 3])
    return vertices, torch.stack([first, second], 1).reshape(-1, 3)


def test_boxes_split_what_covers_itself():
    atlas = by_boxes(*helix(), texture_size=SIZE, gutter_px=GUTTER)
    assert atlas.texels.overlaps == 0
    assert 3 <= atlas.charts <= 20


def test_boxes_take_any_number_of_charts_in_any_texture():
    generator = torch.Generator().manual_seed(0)
    vertices = torch.rand(900, 3, generator=generator)
    faces = torch.arange(900).view(-1, 3)
    faces[0] = 0  # no area at all
    for size in (256, 16):
        atlas = by_boxes(vertices, faces, texture_size=size, gutter_px=GUTTER)
        assert atlas.texels.overlaps == 0
        assert torch.isfinite(atlas.uv).all()
        assert atlas.uv.min() >= 0
        assert atlas.uv.max() <= 1


@pytest.mark.parametrize(
    ("program", "reason"),
    [
        ("import time; time.sleep(60)", "did not end within 0.5 s"),
        ("raise SystemExit(3)", "exit status 3"),
        ("print('no atlas')", "xatlas failed"),
    ],
)
def test_boxes_take_over_when_xatlas_hangs_or_fails(bumpy, monkeypatch, tmp_path, program, reason):
    worker = tmp_path / "worker.py"
    worker.write_text(program)
    monkeypatch.setattr(xatlas_process, "__file__", str(worker))
    atlas = unwrap(
        *bumpy, texture_size=64, gutter_px=2, timeout_s=0.5 if "sleep" in program else 30.0
    )
    assert reason in atlas.fallback
    assert atlas.texels.overlaps == 0


def test_process_whose_parent_was_killed_ends_by_itself():
    command = [sys.executable, "-P", xatlas_process.__file__, "1"]
    # Nobody closes its input: without the alarm it would wait for the rest of the mesh for ever.
    with subprocess.Popen(command, stdin=subprocess.PIPE) as process:
        assert process.wait(timeout=60) == -signal.SIGALRM


def test_unwrapping_is_deterministic(bumpy):
    a, b = (unwrap(*bumpy, texture_size=64, gutter_px=2, timeout_s=120.0) for _ in range(2))
    assert a.fallback is None
    assert torch.equal(a.uv, b.uv)
    assert torch.equal(a.faces, b.faces)
