import json

import pytest
import torch
from sphere_orbit import sphere_cameras, sphere_images

from benchmarks.evaluate_asset import evaluate, light_errors, shade_images, visible
from svim3d.io.glb import glb_bytes, read_mesh
from svim3d.mesh.lathe import revolve
from svim3d.shading.environment import latlong_solid_angles


def ball(radius):
    angle = torch.linspace(-torch.pi / 2, torch.pi / 2, 49)
    profile = radius * torch.stack([angle.cos(), angle.sin()], 1)
    profile[[0, -1], 0] = 0.0
    return revolve(profile, rounds=0, segments=96)


def test_inner_walls_are_not_seen_and_outer_ones_are():
    outer, inner = ball(0.5), ball(0.4)
    vertices = torch.cat([outer.vertices, inner.vertices])
    faces = torch.cat([outer.faces, inner.faces + len(outer.vertices)])
    seen = visible(vertices, vertices, faces)
    assert bool(seen[: len(outer.vertices)].all())
    assert not bool(seen[len(outer.vertices) :].any())


@pytest.mark.parametrize("name", ["light_error", "light_error_blocks"])
def test_light_errors_of_scaled_light_and_of_fine_detail(name):
    generator = torch.Generator().manual_seed(0)
    light = torch.rand(32, 64, 3, generator=generator)
    assert light_errors(light, light)[name] == 0.0
    assert light_errors(1.25 * light, light)[name] == pytest.approx(0.25, abs=1e-6)
    # Detail finer than 16 x 32 hardly counts: half the light's size here, gone after blurring.
    checker = 0.5 * (-1.0) ** (torch.arange(64)[None, :, None] + torch.arange(32)[:, None, None])
    even = latlong_solid_angles(32, 64, light)
    detailed = 1.0 + checker * even.min() / even
    assert light_errors(detailed, torch.ones(32, 64, 3))[name] < 0.02


def test_true_images_shaded_by_their_own_colour():
    cameras = sphere_cameras(3, 24)
    images = sphere_images(cameras)
    shown = shade_images(images, cameras, 1, lambda normal, wo, materials: materials.basecolor)
    assert torch.equal(shown, images["basecolor"][1] * images["mask"][1])


@pytest.mark.slow
def test_the_true_asset_is_perfect(data, tmp_path):
    orbit = data / "orbits" / "barrel"
    mesh = read_mesh(data / "glb" / "ExplodingBarrel_1k.glb")
    index = json.loads((orbit / "orbit.json").read_text())
    to_world = torch.tensor(index["source_to_world"])
    scale = float(torch.linalg.det(to_world[:3, :3])) ** (1 / 3)
    turn = to_world[:3, :3] / scale
    material = mesh.materials[0]
    roughness_metallic = material.roughness_metallic
    content = glb_bytes(
        vertices=mesh.vertices @ to_world[:3, :3].T + to_world[:3, 3],
        faces=mesh.faces,
        normals=mesh.normals @ turn.T,
        uv=mesh.uv,
        tangents=torch.cat([mesh.tangents[:, :3] @ turn.T, mesh.tangents[:, 3:]], 1),
        basecolor=material.basecolor,
        orm=torch.cat([torch.ones_like(roughness_metallic[..., :1]), roughness_metallic], -1),
        normal_tangent=material.normal_tangent,
    )
    (tmp_path / "asset.glb").write_bytes(content)
    figures = evaluate(tmp_path / "asset.glb", orbit, None)
    assert figures["distance"] < 1e-6
    assert figures["volume_iou"] == 1.0
    assert figures["normal_deg"] < 0.2
    assert figures["basecolor_db"] > 45
    assert figures["roughness_db"] > 45
    assert figures["mask_iou"] > 0.99
    # Shaded per sample instead of per pixel it is at least as near to the path tracer.
    assert figures["relight_delta_db"] > 0.0
