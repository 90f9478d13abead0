"""EXR planes survive the disk bit by bit; what is no EXR is refused by name."""

import numpy as np
import OpenEXR
import pytest

from svim3d.io.exr import read_colour, read_exr, read_rgb, write_exr, write_layers, write_rgb


def test_half_values_round_trip_bit_exact(tmp_path):
    rng = np.random.default_rng(0)
    planes = {
        name: rng.normal(size=(7, 5)).astype(np.float16).astype(np.float32)
        for name in ("R", "G", "B", "A", "normal.X", "roughness.V")
    }
    write_exr(tmp_path / "a.exr", planes)
    back = read_exr(tmp_path / "a.exr")
    assert set(back) == set(planes)
    for name, plane in planes.items():
        assert np.array_equal(back[name], plane)


def test_full_precision_round_trips_bit_exact(tmp_path):
    rgb = np.random.default_rng(1).normal(size=(4, 6, 3)).astype(np.float32) * 1e6
    write_rgb(tmp_path / "a.exr", rgb, half=False)
    assert np.array_equal(read_rgb(tmp_path / "a.exr"), rgb)


def test_depth_keeps_full_precision_beside_half_channels(tmp_path):
    depth = np.full((2, 2), 2.000123, np.float32)
    write_exr(tmp_path / "a.exr", {"R": depth, "depth.Z": depth})
    back = read_exr(tmp_path / "a.exr")
    assert np.array_equal(back["depth.Z"], depth)
    assert not np.array_equal(back["R"], depth)


def test_values_beyond_half_are_clipped_not_infinite(tmp_path):
    write_rgb(tmp_path / "a.exr", np.full((2, 2, 3), 1e6, np.float32))
    assert float(read_rgb(tmp_path / "a.exr").max()) == 65504.0


@pytest.mark.parametrize("content", [b"", b"not an image", b"\x76\x2f\x31\x01 truncated"])
def test_unreadable_file_is_named(tmp_path, content):
    file = tmp_path / "broken.exr"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=r"broken\.exr"):
        read_exr(file)


def test_missing_colour_channels_are_named(tmp_path):
    write_exr(tmp_path / "a.exr", {"R": np.zeros((2, 2), np.float32)})
    with pytest.raises(ValueError, match="'G', 'B'"):
        read_rgb(tmp_path / "a.exr")


def test_layers_are_those_other_programs_read(tmp_path):
    rng = np.random.default_rng(0)

    def random(channels: int) -> np.ndarray:
        return rng.random((6, 9, channels)).astype(np.float16).astype(np.float32) * 8

    layers = {"beauty": random(4), "diffuse": random(3), "specular": random(3), "ao": random(1)}
    write_layers(tmp_path / "a.exr", layers)
    names = {"R", "G", "B", "A", "ao.Y"}
    names |= {f"{layer}.{c}" for layer in ("diffuse", "specular") for c in "RGB"}
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as image:
        assert len(image.parts) == 1
        assert set(image.channels()) == names
        for name, channel in image.channels().items():
            layer, _, letter = name.rpartition(".")
            plane = layers[layer or "beauty"][..., "RGBA".find(letter) % 4 if layer != "ao" else 0]
            assert channel.pixels.dtype == np.float16
            assert np.array_equal(channel.pixels.astype(np.float32), plane)
    assert np.array_equal(read_colour(tmp_path / "a.exr"), layers["beauty"][..., :3])


def test_layers_beyond_half_are_clipped_and_told(tmp_path):
    told = []
    beauty = np.zeros((2, 2, 4), np.float32)
    beauty[0, 0, 1] = 1e6
    write_layers(tmp_path / "a.exr", {"beauty": beauty}, notify=lambda *event: told.append(event))
    assert told == [("clipped", "a.exr: 1 pixels above 65504 were clipped")]
    assert float(read_exr(tmp_path / "a.exr")["G"].max()) == 65504.0


def test_layers_of_different_size_are_refused(tmp_path):
    with pytest.raises(ValueError, match="of one size"):
        write_layers(
            tmp_path / "a.exr",
            {"beauty": np.zeros((2, 2, 3), np.float32), "diffuse": np.zeros((2, 4, 3), np.float32)},
        )
    with pytest.raises(ValueError, match="wanted layer diffuse"):
        write_layers(tmp_path / "a.exr", {"diffuse": np.zeros((2, 2, 2), np.float32)})
