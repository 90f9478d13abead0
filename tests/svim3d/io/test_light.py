"""Any file that holds light comes back as linear radiance; what is none is refused or told."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from svim3d.color import linear_from_srgb
from svim3d.io.exr import write_exr, write_rgb
from svim3d.io.hdr import write_hdr
from svim3d.io.image import write_png
from svim3d.io.light import SUFFIXES, read_light
from svim3d.shading.octahedral import DOUBLE, texel_solid_angles

REAL = os.environ.get("SVIM3D_DATA")


class Told(list):
    """Collects what a reader tells."""

    def __call__(self, kind: str, message: str) -> None:
        self.append(kind)


def radiance(height: int = 8, width: int = 16) -> np.ndarray:
    rng = np.random.default_rng(1)
    return (rng.random((height, width, 3)) * 10).astype(np.float16).astype(np.float32)


@pytest.mark.parametrize("half", [True, False])
def test_exr_is_read_bit_exact(tmp_path, half):
    told = Told()
    write_rgb(tmp_path / "a.exr", radiance(), half=half)
    light = read_light(tmp_path / "a.exr", told)
    assert np.array_equal(light.radiance.numpy(), radiance())
    assert light.layout == "latlong"
    assert told == []


def test_exr_layers_grey_and_extra_channels(tmp_path):
    rgb, other = radiance(), radiance() * 0.5
    planes = {f"ViewLayer.Combined.{c}": rgb[..., i] for i, c in enumerate("RGB")}
    planes |= {f"ViewLayer.Albedo.{c}": other[..., i] for i, c in enumerate("RGB")}
    write_exr(tmp_path / "a.exr", planes | {"depth.Z": other[..., 0]})
    assert np.array_equal(read_light(tmp_path / "a.exr").radiance.numpy(), rgb)
    plain = {c: other[..., i] for i, c in enumerate("RGB")}
    write_exr(tmp_path / "b.exr", planes | plain | {"A": rgb[..., 0]})
    assert np.array_equal(read_light(tmp_path / "b.exr").radiance.numpy(), other)
    write_exr(tmp_path / "c.exr", {"Y": rgb[..., 0], "A": rgb[..., 1]})
    assert np.array_equal(read_light(tmp_path / "c.exr").radiance[..., 2].numpy(), rgb[..., 0])
    write_exr(tmp_path / "d.exr", {"R": rgb[..., 0], "G": rgb[..., 1]})
    with pytest.raises(ValueError, match=r"d\.exr, got \['G', 'R'\]"):
        read_light(tmp_path / "d.exr")


@pytest.mark.parametrize("suffix", [".hdr", ".pic", ".HDR"])
def test_radiance_picture(tmp_path, suffix):
    told = Told()
    write_hdr(tmp_path / f"a{suffix}", radiance())
    read = read_light(tmp_path / f"a{suffix}", told).radiance.numpy()
    assert np.allclose(read, radiance(), rtol=0, atol=10 / 256)
    assert told == []


def test_display_pictures_are_decoded_and_told(tmp_path):
    encoded = torch.arange(8 * 16 * 3).view(8, 16, 3).float() / 383.0
    pixels = (encoded * 255).round().byte()
    expected = linear_from_srgb(pixels / 255.0)
    for suffix in (".png", ".tif", ".webp", ".jpg"):
        told = Told()
        file = tmp_path / f"a{suffix}"
        exact = {"lossless": True} if suffix == ".webp" else {"quality": 100}
        Image.fromarray(pixels.numpy()).save(file, **exact)
        light = read_light(file, told)
        tolerance = 0.05 if suffix == ".jpg" else 1e-6
        torch.testing.assert_close(light.radiance, expected, rtol=0, atol=tolerance)
        assert told == ["ldr_light"]


def test_grey_opacity_and_sixteen_bit_pictures(tmp_path):
    grey = np.arange(128, dtype=np.uint16).reshape(8, 16) * 500
    Image.fromarray(grey).save(tmp_path / "a.png")
    expected = linear_from_srgb(torch.from_numpy(grey.astype(np.float32)) / 65535.0)
    read = read_light(tmp_path / "a.png").radiance
    torch.testing.assert_close(read, expected[..., None].expand(-1, -1, 3))
    write_png(tmp_path / "b.png", torch.full((8, 16, 4), 0.5))
    assert read_light(tmp_path / "b.png").radiance.shape == (8, 16, 3)


@pytest.mark.parametrize(
    ("height", "width", "layout", "told"),
    [
        (1, 2, "latlong", []),
        (1, 1, "octahedral", []),
        (7, 9, "latlong", ["light_layout"]),
        (12, 9, "cube cross", []),
    ],
)
def test_any_size_becomes_an_octahedral_map(tmp_path, height, width, layout, told):
    heard = Told()
    write_rgb(tmp_path / "a.exr", np.full((height, width, 3), 2.0, np.float32))
    light = read_light(tmp_path / "a.exr", heard)
    assert (light.layout, heard) == (layout, told)
    torch.testing.assert_close(
        light.octahedral(), torch.full((16, 16, 3), 2.0), rtol=1.1e-3, atol=0
    )


def test_layout_can_be_stated(tmp_path):
    write_rgb(tmp_path / "a.exr", np.ones((9, 9, 3), np.float32))
    assert read_light(tmp_path / "a.exr", layout="latlong").layout == "latlong"


def test_impossible_texels_are_mended_counted_and_told(tmp_path):
    values = radiance()
    values[0, 0], values[1, 1, 1], values[2, 2, 0] = -5.0, np.nan, np.inf
    write_exr(tmp_path / "a.exr", {c: values[..., i] for i, c in enumerate("RGB")}, half=False)
    messages = []
    light = read_light(tmp_path / "a.exr", lambda kind, message: messages.append((kind, message)))
    assert messages == [("light_mended", "a.exr: 3 texels were no light")]
    assert float(light.radiance[0, 0].max()) == 0.0
    assert float(light.radiance[2, 2, 0]) == float(light.radiance.max())
    assert bool(torch.isfinite(light.radiance).all())


def test_black_light_is_allowed_and_told(tmp_path):
    told = Told()
    write_rgb(tmp_path / "a.exr", np.zeros((8, 16, 3), np.float32))
    assert float(read_light(tmp_path / "a.exr", told).octahedral().max()) == 0.0
    assert told == ["light_dark"]


@pytest.mark.parametrize("suffix", [s for s in SUFFIXES if s != ".rgbe"])
@pytest.mark.parametrize("content", [b"", b"dear diary", b"\x00" * 200])
def test_what_is_no_light_is_refused_by_name(tmp_path, suffix, content):
    (tmp_path / f"bad{suffix}").write_bytes(content)
    with pytest.raises(ValueError, match=rf"bad\{suffix}"):
        read_light(tmp_path / f"bad{suffix}")


@pytest.mark.parametrize("suffix", [".exr", ".hdr", ".png"])
def test_truncated_light_is_refused_by_name(tmp_path, suffix):
    file = tmp_path / f"a{suffix}"
    values = np.random.default_rng(0).random((64, 128, 3)).astype(np.float32)
    if suffix == ".exr":
        write_rgb(file, values)
    elif suffix == ".hdr":
        write_hdr(file, values)
    else:
        write_png(file, torch.from_numpy(values))
    content = file.read_bytes()
    for share in (0.2, 0.5, 0.95):
        file.write_bytes(content[: int(share * len(content))])
        with pytest.raises(ValueError, match=rf"a\{suffix}"):
            read_light(file)


def test_missing_and_unknown_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"none\.exr does not exist"):
        read_light(tmp_path / "none.exr")
    (tmp_path / "a.bmp2").write_bytes(b"x")
    with pytest.raises(ValueError, match=r"wanted a light as \.exr, \.hdr"):
        read_light(tmp_path / "a.bmp2")
    (tmp_path / "folder.exr").mkdir()
    with pytest.raises(ValueError, match=r"folder\.exr"):
        read_light(tmp_path / "folder.exr")


def test_huge_claims_are_refused_before_memory_is_taken(tmp_path):
    write_rgb(tmp_path / "a.exr", radiance(8, 16))
    content = (tmp_path / "a.exr").read_bytes()
    small = np.array([0, 0, 15, 7], "<i4").tobytes()
    huge = np.array([0, 0, 999_999_999, 999_999_999], "<i4").tobytes()
    assert small in content
    (tmp_path / "a.exr").write_bytes(content.replace(small, huge))
    with pytest.raises(ValueError, match=r"a\.exr"):
        read_light(tmp_path / "a.exr")
    (tmp_path / "a.hdr").write_bytes(b"#?RADIANCE\n\n-Y 1000000000 +X 1000000000\n")
    with pytest.raises(ValueError, match=r"a\.hdr.*at most"):
        read_light(tmp_path / "a.hdr")


@pytest.mark.skipif(REAL is None, reason="SVIM3D_DATA names no data folder")
@pytest.mark.parametrize("file", sorted(Path(REAL or ".").glob("hdri/*.exr")), ids=lambda f: f.stem)
def test_real_lights_are_physical_and_keep_their_energy(file):
    light = read_light(file, Told())
    octahedral = light.octahedral(64)
    assert light.layout == "latlong"
    assert bool((octahedral >= 0).all())
    omega = texel_solid_angles(64, DOUBLE)[..., None]
    coarse = (octahedral.double() * omega).sum((0, 1))
    fine = light.octahedral(256).double() * texel_solid_angles(256, DOUBLE)[..., None]
    torch.testing.assert_close(coarse, fine.sum((0, 1)), rtol=1e-5, atol=0)
