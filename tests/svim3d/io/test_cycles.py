"""What is exchanged with Cycles, what is said when it fails, and where its light comes from."""

import json
import math
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from fake_cycles import COVERAGE, executable, fake_interpreter

from svim3d.cameras import orbit_cameras
from svim3d.io.cycles import LIGHT_ROWS, Cycles, render_with_cycles
from svim3d.io.exr import read_rgb
from svim3d.mesh.micropolygons import Micropolygons
from svim3d.numerics import normalize, reflect
from svim3d.shading.environment import latlong_from_octahedral
from svim3d.shading.octahedral import sample_octahedral, texel_directions, texel_solid_angles

CAMERAS = orbit_cameras([(20.0, 30.0), (-35.0, 100.0)], radius=2.2, fov_y_deg=33.8, size=24)


def sphere(*, roughness: float, metallic: float) -> Micropolygons:
    """A white ball of radius 1/2 about the origin."""
    rows = 24
    polar = torch.linspace(0.0, math.pi, rows + 1)[:, None]
    around = torch.linspace(0.0, 2.0 * math.pi, 2 * rows + 1)
    points = [polar.sin() * around.cos(), polar.cos().expand(-1, 2 * rows + 1)]
    grid = torch.stack([*points, polar.sin() * around.sin()], -1)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    halves = [torch.stack(corners, -2).view(-1, 3, 3) for corners in ((a, c, b), (a, d, c))]
    normal = torch.cat(halves)
    one = torch.ones(len(normal), 3, 1)
    return Micropolygons(0.5 * normal, normal, one.repeat(1, 1, 3), roughness * one, metallic * one)


def lamps() -> torch.Tensor:
    """Broad lamps from three directions without symmetry, one for each channel."""
    towards = normalize(torch.tensor([[1.0, 0.3, 0.2], [0.1, 1.0, 0.0], [0.3, -0.2, 1.0]]))
    return (texel_directions(32) @ towards.T).clamp_min(0.0) ** 4


def cycles(python: Path | str, *, samples: int = 7, timeout_s: float = 60.0) -> Cycles:
    return Cycles(Path(python), samples, "cpu", timeout_s)


def test_the_exchanged_folder_holds_the_scene_and_brings_the_pictures(tmp_path):
    mesh, lights = sphere(roughness=0.3, metallic=0.0), [lamps(), 1e5 * lamps()]
    pictures = render_with_cycles(cycles(fake_interpreter(tmp_path)), mesh, CAMERAS, lights, seed=9)
    for light, views in enumerate(pictures):
        assert views.shape == (2, 24, 24, 4)
        for view in range(2):
            assert bool((views[view, ..., :3] == COVERAGE * (1 + light + 10 * view)).all())
            assert bool((views[view, ..., 3] == COVERAGE).all())
    kept = tmp_path / "kept"
    corners = np.load(kept / "corners.npz")
    for name in ("position", "normal", "basecolor", "roughness", "metallic"):
        assert torch.equal(torch.from_numpy(corners[name]), getattr(mesh, name))
    for index, light in enumerate(lights):
        expected = latlong_from_octahedral(light, height=LIGHT_ROWS * 32)
        assert torch.equal(torch.from_numpy(read_rgb(kept / f"light_{index}.exr")), expected)
    told = json.loads((kept / "scene.json").read_text())
    assert torch.equal(torch.tensor(told.pop("cameras")), CAMERAS.c2w)
    assert told == {
        "size": 24,
        "fov_y_deg": 33.8,
        "lights": 2,
        "samples": 7,
        "seed": 9,
        "device": "cpu",
    }


def failure(python: Path | str, **settings) -> str:
    with pytest.raises(ValueError) as raised:
        render_with_cycles(
            cycles(python, **settings),
            sphere(roughness=0.3, metallic=0.0),
            CAMERAS,
            [lamps()],
            seed=0,
        )
    assert "\n" not in str(raised.value)
    return str(raised.value)


def test_every_fault_is_one_line_that_says_what_to_do(tmp_path):
    assert "nowhere cannot be started (No such file" in failure(tmp_path / "nowhere")
    # The project's own environment has no bpy.
    assert "it cannot import bpy (No module named 'bpy'" in failure(sys.executable)
    text = "#!/bin/sh\necho working\necho 'RuntimeError: out of memory' >&2\nexit 1\n"
    assert failure(executable(tmp_path / "fails", text)).endswith(": RuntimeError: out of memory")
    silent = executable(tmp_path / "silent", "#!/bin/sh\nexit 3\n")
    assert failure(silent).endswith("nothing was said")
    slow = executable(tmp_path / "slow", "#!/bin/sh\nexec sleep 30\n")
    assert "longer than 0.2 s" in failure(slow, timeout_s=0.2)
    idle = executable(tmp_path / "idle", "#!/bin/sh\nexit 0\n")
    assert "cannot read" in failure(idle)


@pytest.fixture(scope="module")
def blender() -> Path:
    """The interpreter with bpy that SVIM3D_CYCLES_PYTHON names; without it the test is skipped."""
    python = os.environ.get("SVIM3D_CYCLES_PYTHON")
    if not python:
        pytest.skip("SVIM3D_CYCLES_PYTHON names no interpreter with bpy")
    return Path(python)


def test_cycles_sees_the_light_where_we_do(blender):
    # Whatever the light is turned or mirrored by, a channel would show another lamp's place.
    light, even = lamps(), torch.ones(32, 32, 3)
    solid_angles = texel_solid_angles(32).view(-1, 1)
    for metallic, roughness in ((1.0, 0.05), (0.0, 1.0)):
        mesh = sphere(roughness=roughness, metallic=metallic)
        views, white = render_with_cycles(
            cycles(blender, samples=128, timeout_s=3600.0), mesh, CAMERAS, [light, even], seed=1
        )
        for view in range(len(CAMERAS)):
            origin, direction = CAMERAS.rays(view)
            along = (origin * direction).sum(-1, keepdim=True)
            under_root = along**2 - (origin**2).sum(-1, keepdim=True) + 0.25
            normal = (origin + (-along - under_root.clamp_min(0.0).sqrt()) * direction) / 0.5
            inner = under_root[:, 0] > 0.06  # a pixel at the rim averages over much of the sphere
            if metallic:
                expected = sample_octahedral(light, reflect(-direction, normal))
            else:
                cosine = (normal @ texel_directions(32).view(-1, 3).T).clamp_min(0.0)
                expected = cosine @ (solid_angles * light.view(-1, 3)) / math.pi
            seen = views[view].view(-1, 4)
            assert bool((seen[inner, 3] == 1.0).all())
            for channel in range(3):
                pair = torch.stack([seen[inner, channel], expected[inner, channel]])
                assert float(torch.corrcoef(pair)[0, 1]) > 0.99
            # In even light a white surface that loses nothing shines as the light does.
            mean = white[view].view(-1, 4)[inner, :3].mean()
            torch.testing.assert_close(mean, torch.tensor(1.0), atol=0.01, rtol=0.0)
