import math

import pytest
import torch
from textured_sphere import LEFT, RIGHT, ROUGH, sphere_glb

from svim3d.io.glb import glb_bytes, reopen_glb
from svim3d.io.gltf_shrink import shrink_glb


def with_noise(side):
    """A square whose textures are as large as pictures get: no two texels alike."""
    generator = torch.Generator().manual_seed(1)
    tilt = torch.rand(side, side, 2, generator=generator) - 0.5
    normal = torch.cat([tilt, torch.ones(side, side, 1)], -1)
    return glb_bytes(
        vertices=torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]),
        faces=torch.tensor([[0, 1, 2], [0, 2, 3]]),
        normals=torch.tensor([[0.0, 0, 1]]).expand(4, 3),
        uv=torch.tensor([[0.0, 1], [1, 1], [1, 0], [0, 0]]),
        tangents=torch.tensor([[1.0, 0, 0, 1]]).expand(4, 4),
        basecolor=torch.rand(side, side, 3, generator=generator),
        orm=torch.rand(side, side, 3, generator=generator),
        normal_tangent=torch.nn.functional.normalize(normal, dim=-1),
    )


def test_what_is_small_enough_stays_as_it_is():
    content = sphere_glb()
    assert shrink_glb(content, len(content)) == (content, 0)


def test_textures_are_halved_until_the_file_is_small_enough_and_mean_the_same():
    content = with_noise(256)
    smaller, side = shrink_glb(content, len(content) // 5)
    assert side == 64 and len(smaller) <= len(content) // 5
    before, after = reopen_glb(content), reopen_glb(smaller)
    assert torch.equal(before.vertices, after.vertices) and torch.equal(before.uv, after.uv)
    assert after.basecolor.shape == (64, 64, 3)
    blocks = before.basecolor.view(64, 4, 64, 4, 3).mean((1, 3))  # linear light
    assert float((after.basecolor - blocks).abs().max()) < 0.01
    rough = before.orm.view(64, 4, 64, 4, 3).mean((1, 3))
    assert float((after.orm - rough).abs().max()) < 1.1 / 255
    length = after.normal_tangent.norm(dim=-1)
    assert float((length - 1.0).abs().max()) < 0.02


def test_edges_of_flat_regions_stay_where_they_are():
    content = sphere_glb(texture=512)
    smaller, side = shrink_glb(content, len(content) - 1)
    found = reopen_glb(smaller)
    half = side // 2
    assert torch.allclose(found.basecolor[:, :half], torch.tensor(LEFT), atol=0.01)
    assert torch.allclose(found.basecolor[:, half:], torch.tensor(RIGHT), atol=0.01)
    assert math.isclose(float(found.orm[0, 0, 1]), ROUGH, abs_tol=0.01)


def test_geometry_that_is_too_large_is_not_cut():
    assert shrink_glb(sphere_glb(), 4000) is None
    assert shrink_glb(sphere_glb(texture=0), 4000) is None


def test_another_file_is_refused():
    with pytest.raises(ValueError, match=r"wanted a \.glb"):
        shrink_glb(b"no asset at all", 4)
