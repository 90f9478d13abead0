import pytest
import torch

from svim3d.io.glb import read_mesh
from svim3d.io.obj import obj_files


def asset():
    generator = torch.Generator().manual_seed(0)
    maps = torch.randint(0, 256, (2, 4, 4, 3), generator=generator).float() / 255
    return {
        "vertices": torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.125]]),
        "faces": torch.tensor([[0, 1, 2], [0, 2, 3]]),
        "normals": torch.tensor([[0.0, 0, 1]]).repeat(4, 1),
        "uv": torch.tensor([[0.0, 1], [1, 1], [1, 0], [0, 0.25]]),
        "basecolor": maps[0],
        "orm": maps[1],
        "normal_tangent": torch.tensor([0.0, 0, 1]).expand(4, 4, 3),
    }


def write(folder, files):
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder / "asset.obj"


def test_textured_obj_reads_back(tmp_path):
    wanted = asset()
    mesh = read_mesh(write(tmp_path, obj_files(**wanted)))
    corner = mesh.faces.reshape(-1).long()
    source = wanted["faces"].reshape(-1)
    assert torch.allclose(mesh.vertices[corner], wanted["vertices"][source])
    assert torch.allclose(mesh.uv[corner], wanted["uv"][source], atol=1e-6)
    material = mesh.materials[0]
    assert (material.basecolor - wanted["basecolor"]).abs().max() < 0.01
    assert torch.allclose(material.roughness_metallic, wanted["orm"][..., 1:], atol=1e-6)
    assert mesh.tangents.norm(dim=1).min() > 1  # unit tangent and handedness


def test_painted_obj_keeps_colours_and_equal_bytes(tmp_path):
    wanted = asset() | {"uv": None, "normal_tangent": None}
    wanted |= {"basecolor": torch.rand(4, 3), "orm": torch.rand(4, 3)}
    files = obj_files(**wanted)
    assert files == obj_files(**wanted)
    mesh = read_mesh(write(tmp_path, files))
    expected = float(wanted["orm"][:, 1].mean())
    assert mesh.materials[0].roughness_factor == pytest.approx(expected, abs=1e-6)


def test_mtl_factors_and_missing_textures(tmp_path):
    file = tmp_path / "a.obj"
    file.write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\nf 1 2 3\n")
    (tmp_path / "a.mtl").write_text("newmtl m\nKd 0.2 0.4 0.6\nNs 30\nPm 0.75\n")
    material = read_mesh(file).materials[0]
    assert material.basecolor_factor == (0.2, 0.4, 0.6)
    assert material.roughness_factor == pytest.approx(0.5)  # alpha^2 = 2 / 32
    assert material.metallic_factor == 0.75
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Pr absent.png\n")
    with pytest.raises(ValueError, match=r"absent\.png"):
        read_mesh(file)


def test_an_obj_without_faces_is_refused(tmp_path):
    file = tmp_path / "a.obj"
    file.write_text("v 0 0 0\n")
    with pytest.raises(ValueError, match=r"a\.obj"):
        read_mesh(file)


def test_one_value_becomes_factors_and_maps_hold_only_what_varies(tmp_path):
    wanted = asset() | {"uv": None, "normal_tangent": None}
    wanted |= {"basecolor": torch.tensor([0.5, 0.25, 0.125])}
    wanted |= {"orm": torch.tensor([1.0, 0.3, 0.9])}
    files = obj_files(**wanted)
    assert set(files) == {"asset.obj", "asset.mtl"}
    assert b"vt " not in files["asset.obj"]
    material = read_mesh(write(tmp_path, files)).materials[0]
    assert material.basecolor_factor == (0.5, 0.25, 0.125)
    assert (material.roughness_factor, material.metallic_factor) == pytest.approx((0.3, 0.9))
    varied = asset() | {"orm_factor": torch.tensor([1.0, 0.4, 1.0])}
    varied["orm"][..., 1] = 1.0
    files = obj_files(**varied)
    assert "asset_roughness.png" not in files
    material = read_mesh(write(tmp_path, files)).materials[0]
    assert material.roughness_factor == pytest.approx(0.4)
    assert torch.allclose(material.roughness_metallic[..., 1], varied["orm"][..., 2], atol=1e-6)
