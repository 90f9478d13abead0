"""Scene files: a small object described by curves and patterns instead of triangles and pictures.

A scene is JSON: `materials` by name, and `parts`, each a `lathe` profile [[radius, height], ...] or
a `tube` path [[x, y, z, radius], ...] whose stretches between control points are given materials:
`bands` lists [last control index, material name]. A material mixes two ends of `basecolor`
(linear) and `roughness` by a `pattern`; `metallic` is one number. Patterns:

- `plain`: the first end everywhere;
- `noise`: smooth noise with `cells` [around, along] of the coarsest octave;
- `rings`: fine noise along the curve only, as a lathe tool leaves it, with `cells` rings;
- `stripes`: `count` soft-edged stripes around, turned by `twist` per control point;
- `speckle`: noise pushed to its extremes, a few dark spots on an even ground.
"""

import json
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.io.glb import read_mesh
from svim3d.mesh.lathe import Body, revolve, sweep
from svim3d.mesh.source_mesh import SourceMaterial, SourceMesh, merge
from svim3d.numerics import smoothstep

SCENE_SUFFIX = ".json"
SMOOTHING_ROUNDS = 4
LATHE_SEGMENTS, TUBE_SEGMENTS = 128, 32
TEXTURE_HEIGHT, TEXTURE_WIDTH = 1024, 1024
OCTAVES = 3  # each of half the size and half the weight of the one before
STRIPE_EDGE = 0.12  # half width of a stripe's soft edge, share of its period
SPECKLE_LOW, SPECKLE_HIGH = 0.62, 0.72  # noise below is ground, above is spot


def read_scene(file: Path) -> SourceMesh:
    """Build the object that a scene file describes; equal files give equal meshes.

    Raises:
        ValueError: the file is no scene, or names what it does not define.
    """
    try:
        scene = json.loads(file.read_text())
        materials, parts = scene["materials"], scene["parts"]
        bodies = [_body(part) for part in parts]
        textures = tuple(_material(part, materials) for part in parts)
    except (OSError, json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"wanted a scene as JSON in {file}, cannot read it: {error}") from error
    except (KeyError, TypeError) as error:
        raise ValueError(
            f"wanted parts with known materials in the scene {file}, but {error} is missing or "
            "of the wrong kind; see configs/example.json"
        ) from error
    return merge([_source_mesh(body, i, textures) for i, body in enumerate(bodies)])


def read_object(file: Path) -> SourceMesh:
    """Read a scene file (.json) or a mesh file.

    Raises:
        ValueError: see `read_scene` and `read_mesh`.
    """
    return read_scene(file) if file.suffix.lower() == SCENE_SUFFIX else read_mesh(file)


def _body(part: dict[str, Any]) -> Body:
    """The surface of one part."""
    if "lathe" in part:
        profile = torch.tensor(part["lathe"], dtype=torch.float32)
        return revolve(profile, rounds=SMOOTHING_ROUNDS, segments=LATHE_SEGMENTS)
    path = torch.tensor(part["tube"], dtype=torch.float32)
    return sweep(path, rounds=SMOOTHING_ROUNDS, segments=TUBE_SEGMENTS)


def _source_mesh(body: Body, material: int, materials: tuple[SourceMaterial, ...]) -> SourceMesh:
    return SourceMesh(
        vertices=body.vertices,
        faces=body.faces,
        normals=body.normals,
        uv=body.uv,
        tangents=torch.zeros(len(body.vertices), 4),
        colors=torch.ones_like(body.vertices),
        face_material=torch.full((len(body.faces),), material, dtype=torch.int32),
        materials=materials,
    )


def _material(part: dict[str, Any], materials: dict[str, Any]) -> SourceMaterial:
    """Textures of one part, band by band along its curve."""
    controls = len(part["lathe"] if "lathe" in part else part["tube"])
    along = (torch.arange(TEXTURE_HEIGHT) + 0.5) / TEXTURE_HEIGHT * (controls - 1)
    around = (torch.arange(TEXTURE_WIDTH) + 0.5) / TEXTURE_WIDTH
    texture = torch.zeros(TEXTURE_HEIGHT, TEXTURE_WIDTH, 5)
    start = 0.0
    for last, name in part["bands"]:
        rows = (along >= start) & (along <= last)
        texture[rows] = _paint(materials[name], around, along)[rows]
        start = last
    return SourceMaterial(
        basecolor=texture[..., :3].contiguous(), roughness_metallic=texture[..., 3:].contiguous()
    )


def _paint(
    material: dict[str, Any], around: Float[Tensor, "W"], along: Float[Tensor, "H"]
) -> Float[Tensor, "H W 5"]:
    """Basecolor, roughness and metallic of a material over (along, around)."""
    weight = _pattern(material, around, along)[..., None]
    first, second = (
        torch.tensor([*material["basecolor"][end], float(material["roughness"][end])])
        for end in (0, -1)
    )
    mixed = first + weight * (second - first)
    return torch.cat([mixed, torch.full_like(weight, float(material["metallic"]))], -1)


def _pattern(
    material: dict[str, Any], around: Float[Tensor, "W"], along: Float[Tensor, "H"]
) -> Float[Tensor, "H W"]:
    """Weight of a material's second end, in [0, 1]."""
    kind, shape = material["pattern"], (len(along), len(around))
    if kind == "plain":
        return torch.zeros(shape)
    if kind == "stripes":
        turn = around[None] * material["count"] + along[:, None] * material["twist"]
        from_edge = (turn % 1.0 - 0.5).abs() - 0.25
        return smoothstep(from_edge / (2.0 * STRIPE_EDGE) + 0.5)
    if kind == "rings":
        return _noise((int(material["cells"]), 1), shape)
    columns, rows = material["cells"]
    noise = _noise((int(rows), int(columns)), shape)
    if kind == "speckle":
        return smoothstep((noise - SPECKLE_LOW) / (SPECKLE_HIGH - SPECKLE_LOW))
    if kind == "noise":
        return noise
    raise ValueError(f"wanted a pattern among plain, noise, rings, stripes, speckle; got '{kind}'")


def _noise(cells: tuple[int, int], shape: tuple[int, int]) -> Float[Tensor, "H W"]:
    """Octaves of smooth value noise in [0, 1], periodic around."""
    rows, columns = cells
    # The seed is the shape of the lattice: equal materials look equal in every part.
    generator = torch.Generator().manual_seed(rows * 65537 + columns)
    total, weight = torch.zeros(shape), 1.0
    for octave in range(OCTAVES):
        size = (rows << octave) + 1, max(1, columns << octave) if columns > 1 else 1
        lattice = torch.rand(size, generator=generator)
        total += weight * _interpolated(lattice, shape)
        weight *= 0.5
    return total / (2.0 - 2.0 * weight)


def _interpolated(lattice: Float[Tensor, "h w"], shape: tuple[int, int]) -> Float[Tensor, "H W"]:
    """Smooth interpolation of lattice values; columns wrap around."""
    y = (torch.arange(shape[0]) + 0.5) / shape[0] * (lattice.shape[0] - 1)
    x = (torch.arange(shape[1]) + 0.5) / shape[1] * lattice.shape[1]
    row, column = y.floor().long(), x.floor().long() % lattice.shape[1]
    fy, fx = smoothstep(y - y.floor())[:, None], smoothstep(x - x.floor())[None]
    right = (column + 1) % lattice.shape[1]
    top = lattice[row][:, column] * (1 - fx) + lattice[row][:, right] * fx
    bottom = lattice[row + 1][:, column] * (1 - fx) + lattice[row + 1][:, right] * fx
    return top * (1 - fy) + bottom * fy
