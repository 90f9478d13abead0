import pytest
import torch

from stages.edit import edit_asset
from stages.errors import InputError
from svim3d.cameras import orbit_cameras
from svim3d.io.edit_record import EditRecord
from svim3d.io.glb import glb_bytes, read_mesh
from svim3d.io.image import encode_png
from svim3d.shading.material_edits import Edit

SIDE = 16  # texels per side of a cube's face in the atlas, three faces across and two down


def cube() -> bytes:
    """A unit cube; faces +x +y +z, then -x -y -z, each in a cell of its own of a 48 x 32 atlas."""
    vertices, normals, uv, faces = [], [], [], []
    for index in range(6):
        axis, sign = index % 3, 1.0 if index < 3 else -1.0
        normal = torch.zeros(3)
        normal[axis] = sign
        across, up = torch.eye(3)[(axis + 1) % 3], torch.eye(3)[(axis + 2) % 3]
        for a, b in ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)):
            vertices.append(0.5 * (normal + sign * a * across + b * up))
            normals.append(normal)
            uv.append(torch.tensor([(axis + 0.5 + 0.5 * a) / 3, (index // 3 + 0.5 - 0.5 * b) / 2]))
        faces += [[4 * index + k for k in corners] for corners in ((0, 1, 2), (0, 2, 3))]
    generator = torch.Generator().manual_seed(0)
    return glb_bytes(
        vertices=torch.stack(vertices),
        faces=torch.tensor(faces),
        normals=torch.stack(normals),
        uv=torch.stack(uv),
        basecolor=torch.rand(2 * SIDE, 3 * SIDE, 3, generator=generator),
        orm=torch.rand(2 * SIDE, 3 * SIDE, 3, generator=generator),
    )


def cell(image: torch.Tensor, face: str) -> torch.Tensor:
    column, row = "xyz".index(face[1]) * SIDE, (face[0] == "-") * SIDE
    return image[row : row + SIDE, column : column + SIDE]


@pytest.fixture
def asset(tmp_path):
    file = tmp_path / "cube.glb"
    file.write_bytes(cube())
    return file


def material_of(content: bytes, tmp_path):
    file = tmp_path / "edited.glb"
    file.write_bytes(content)
    return read_mesh(file).materials[0]


def record(folder, region, cameras):
    folder.mkdir()
    edits = (Edit.parse("roughness=0.25"), Edit.parse("basecolor*0.5"))
    for name, content in EditRecord(edits, region, cameras).files().items():
        (folder / name).write_bytes(content)
    return folder / "edits.json"


@pytest.mark.parametrize(("azimuth", "face"), [(0.0, "+z"), (90.0, "+x"), (180.0, "-z")])
def test_a_view_of_one_face_changes_that_face_alone(asset, tmp_path, azimuth, face):
    # Close by, the other faces are hidden behind the one in front.
    cameras = orbit_cameras([(0.0, azimuth)], radius=2.0, fov_y_deg=60.0, size=64)
    replay = record(tmp_path / "views", torch.ones(64, 64, 1), cameras)
    content, _ = edit_asset(asset, [], record=replay)
    before, after = read_mesh(asset).materials[0], material_of(content, tmp_path)
    assert torch.equal(
        cell(after.roughness_metallic, face)[..., 0], torch.full((SIDE, SIDE), 64 / 255)
    )
    torch.testing.assert_close(
        cell(after.basecolor, face), 0.5 * cell(before.basecolor, face), rtol=0, atol=0.005
    )
    assert torch.equal(after.roughness_metallic[..., 1], before.roughness_metallic[..., 1])
    for other in {"+x", "+y", "+z", "-x", "-y", "-z"} - {face}:
        for name in ("roughness_metallic", "basecolor"):
            assert torch.equal(
                cell(getattr(after, name), other), cell(getattr(before, name), other)
            )


def test_a_view_of_three_faces_changes_these_three(asset, tmp_path):
    cameras = orbit_cameras([(35.0, 45.0)], radius=3.0, fov_y_deg=33.8, size=128)
    replay = record(tmp_path / "views", torch.ones(128, 128, 1), cameras)
    after = material_of(edit_asset(asset, [], record=replay)[0], tmp_path)
    before = read_mesh(asset).materials[0]
    for face in ("+x", "+y", "+z"):
        assert bool((cell(after.roughness_metallic, face)[..., 0] == 64 / 255).all())
    for face in ("-x", "-y", "-z"):
        assert torch.equal(cell(after.basecolor, face), cell(before.basecolor, face))


def test_a_mask_in_texture_space_may_have_any_proportions(asset, tmp_path):
    mask = torch.zeros(10, 10, 1)
    mask[:5] = 1.0
    (tmp_path / "mask.png").write_bytes(encode_png(mask))
    content, _ = edit_asset(asset, ["metallic=1"], mask=tmp_path / "mask.png")
    metallic = material_of(content, tmp_path).roughness_metallic[..., 1]
    assert bool((metallic[: SIDE - 2] == 1.0).all())
    plain = record(tmp_path / "views", None, None)
    replayed, _ = edit_asset(asset, ["metallic=1"], mask=tmp_path / "mask.png", record=plain)
    assert torch.equal(material_of(replayed, tmp_path).roughness_metallic[..., 1], metallic)
    before = read_mesh(asset).materials[0].roughness_metallic[..., 1]
    assert torch.equal(metallic[SIDE + 2 :], before[SIDE + 2 :])


def test_nothing_to_do_and_bad_masks_are_told(asset, tmp_path):
    with pytest.raises(InputError, match="nothing to edit"):
        edit_asset(asset, [])
    (tmp_path / "black.png").write_bytes(encode_png(torch.zeros(4, 4, 1)))
    with pytest.raises(InputError, match="is empty"):
        edit_asset(asset, ["metallic=1"], mask=tmp_path / "black.png")
    (tmp_path / "cut.png").write_bytes(b"\x89PNG")
    with pytest.raises(InputError, match="cannot decode"):
        edit_asset(asset, ["metallic=1"], mask=tmp_path / "cut.png")
    with pytest.raises(InputError, match="no asset"):
        edit_asset(tmp_path / "absent.glb", ["metallic=1"])
    beside = orbit_cameras([(0.0, 0.0)], radius=3.0, fov_y_deg=33.8, size=64)
    corner = torch.zeros(64, 64, 1)
    corner[0, 0] = 1.0
    with pytest.raises(InputError, match="meets no texel"):
        edit_asset(asset, [], record=record(tmp_path / "views", corner, beside))
