import dataclasses

import pytest
import torch

from svim3d.fields.sdf_grid import node_positions
from svim3d.mesh.atlas import unwrap_boxes
from svim3d.mesh.cleanup import decimate
from svim3d.mesh.frames import bitangents, tangent_frames, tangent_from_world
from svim3d.mesh.marching import extract_surface
from svim3d.mesh.mesh import vertex_normals
from svim3d.mesh.painted_mesh import PaintedMesh
from svim3d.mesh.texels import rasterize_uv, to_image
from svim3d.numerics import normalize
from svim3d.raster.texture import sample_texture
from svim3d.render import texture_transfer
from svim3d.render.texture_transfer import transferred

SIZE = 128


def sphere(faces):
    sdf = 0.4 - node_positions(24, 0.55, like=torch.zeros(1)).norm(dim=-1)
    mesh = decimate(*extract_surface(sdf, 0.55), max_faces=faces)
    return mesh.vertices, mesh.faces


def colour_at(points):
    return 0.5 + 0.45 * torch.sin(6.0 * points)


def shading_at(points):
    """Normals of the sphere, tilted."""
    return normalize(normalize(points) + 0.2 * torch.sin(9.0 * points.roll(1, 1)))


@pytest.fixture(scope="module")
def painted():
    """A textured sphere, its normal map too."""
    vertices, faces = sphere(1200)
    atlas = unwrap_boxes(vertices, faces, texture_size=SIZE, gutter_px=3, reason="test")
    source = atlas.vertex_source.long()
    normals = vertex_normals(vertices, faces)[source]
    frames = tangent_frames(vertices[source], atlas.faces, normals, atlas.uv)
    split = frames.vertex_source.long()
    mesh = PaintedMesh(
        vertices=vertices[source][split],
        faces=frames.faces,
        normals=normals[split],
        uv=atlas.uv[split],
        tangents=frames.tangents,
        basecolor=torch.zeros(SIZE, SIZE, 3),
        orm=torch.tensor([1.0, 0.3, 0.0]),
        normal_tangent=None,
    )
    texels = rasterize_uv(mesh.uv, mesh.faces, SIZE)
    points = texels.interpolate(mesh.faces, mesh.vertices)
    frame = (mesh.normals, mesh.tangents[:, :3], bitangents(mesh.normals, mesh.tangents))
    axes = [texels.interpolate(mesh.faces, axis.contiguous()) for axis in frame]
    local = tangent_from_world(shading_at(points), *axes)
    return dataclasses.replace(
        mesh,
        basecolor=to_image(colour_at(points), texels),
        normal_tangent=to_image(local, texels),
    )


@pytest.fixture(autouse=True)
def boxes_at_once(monkeypatch):
    monkeypatch.setattr(texture_transfer, "ATLAS_TIMEOUT_S", 0.0)


def centres(mesh, attribute):
    return attribute[mesh.faces.long()].mean(1)


def test_textures_follow_to_a_coarser_mesh(painted):
    vertices, faces = sphere(300)
    coarse = transferred(painted, vertices, faces)
    assert len(coarse.faces) == len(faces) < len(painted.faces) / 3
    assert coarse.basecolor.shape == painted.basecolor.shape
    assert torch.equal(coarse.orm, painted.orm)
    points = 0.4 * normalize(centres(coarse, coarse.vertices))
    uv = centres(coarse, coarse.uv)
    error = (sample_texture(coarse.basecolor, uv) - colour_at(points)).abs()
    assert error.mean() < 0.02
    assert error.max() < 0.15
    local = sample_texture(coarse.normal_tangent, uv)
    axes = (coarse.normals, coarse.tangents[:, :3], bitangents(coarse.normals, coarse.tangents))
    normal, tangent, across = (normalize(centres(coarse, axis)) for axis in axes)
    world = normalize(local[:, :1] * tangent + local[:, 1:2] * across + local[:, 2:] * normal)
    cosine = (world * shading_at(points)).sum(1).clamp(-1, 1)
    assert torch.rad2deg(cosine.acos()).mean() < 3.0


def test_a_shrunken_texture_is_the_mean_of_what_its_texels_cover(painted):
    vertices, faces = sphere(300)
    fine = rasterize_uv(painted.uv, painted.faces, SIZE)
    noise = 0.3 * torch.randn(len(fine.pixel), 3, generator=torch.Generator().manual_seed(0))
    noisy = dataclasses.replace(
        painted, basecolor=painted.basecolor + to_image(noise, fine), orm=torch.rand(8, 8, 3)
    )
    small = transferred(noisy, vertices, faces, shrink=4)
    sizes = {name: len(image) for name, image in small.textures.items()}
    assert sizes == {"basecolor": SIZE // 4, "orm": 4, "normal": SIZE // 4}
    length = small.normal_tangent.norm(dim=2)
    assert torch.allclose(length, torch.ones(()), atol=1e-5)

    def error(mesh):
        seen = sample_texture(mesh.basecolor, centres(mesh, mesh.uv))
        return (seen - colour_at(0.4 * normalize(centres(mesh, mesh.vertices)))).square().mean()

    # Noise of single texels is averaged away; picking one in sixteen would keep it.
    assert error(small) < 0.3 * error(transferred(noisy, vertices, faces))


@pytest.mark.parametrize(("shrink", "size"), [(2, 50), (4, 25), (8, 25)])
def test_odd_sides_are_not_halved(painted, shrink, size):
    image = torch.nn.functional.interpolate(painted.basecolor.movedim(-1, 0)[None], 100)[0]
    odd = dataclasses.replace(painted, basecolor=image.movedim(0, -1), normal_tangent=None)
    assert len(transferred(odd, *sphere(300), shrink=shrink).basecolor) == size


def test_a_palette_stays_one_and_seams_go_where_no_map_needs_them(painted):
    two = torch.where(painted.basecolor[..., :1] > 0.5, 0.8, 0.2).expand(-1, -1, 3)
    flat = dataclasses.replace(painted, basecolor=two, normal_tangent=None)
    coarse = transferred(flat.without_needless_seams(), *sphere(300))
    assert coarse.tangents is None
    assert set(coarse.basecolor.unique().tolist()) == set(two.unique().tolist())
    small = transferred(flat.without_needless_seams(), *sphere(300), shrink=2)
    assert len(small.basecolor) == SIZE // 2
    assert set(small.basecolor.unique().tolist()) == set(two.unique().tolist())
    even = dataclasses.replace(flat, basecolor=torch.tensor([0.1, 0.2, 0.3]))
    bare = even.without_needless_seams()
    assert bare.uv is None
    assert len(bare.vertices) == len(sphere(1200)[0])
    vertices, faces = sphere(300)
    coarse = transferred(bare, vertices, faces)
    assert torch.equal(coarse.vertices, vertices)
    assert torch.equal(coarse.basecolor, even.basecolor)


def test_colours_of_vertices_follow(painted):
    per_vertex = dataclasses.replace(
        painted,
        uv=None,
        tangents=None,
        normal_tangent=None,
        basecolor=colour_at(painted.vertices),
        orm=colour_at(painted.vertices),
    )
    vertices, faces = sphere(300)
    coarse = transferred(per_vertex, vertices, faces)
    assert (coarse.basecolor - colour_at(0.4 * normalize(vertices))).abs().mean() < 0.02
    assert coarse.orm.shape == vertices.shape
