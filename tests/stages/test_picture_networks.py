"""Weights that the tests make, in the files that users have them in."""

import importlib.metadata

import numpy as np
import pytest
import torch
from feature_weights import formula_pictures, inception_state, lite0_state
from lpips_weights import blank_state, formula_weights
from transformers import CLIPConfig, CLIPModel

from stages.errors import InputError
from stages.picture_networks import IS_BETTER_HIGH, PictureNetworks
from stages.settings.picture_networks import DISTRIBUTION, PictureNetworkSettings
from svim3d.io.picture_networks import read_clip
from svim3d.io.weights import save_tensors
from svim3d.metrics.features import cmmd, frechet_distance

CPU = torch.device("cpu")
TOWER = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 2}
MEAN, STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)


@pytest.fixture(autouse=True)
def nothing_installed(monkeypatch):
    """Whatever lies on this machine, the tests see only what they make."""

    def lacks(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr("stages.settings.picture_networks.importlib.metadata.distribution", lacks)


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """A tiny CLIP as transformers saves it, and the model itself."""
    torch.manual_seed(0)
    vision = TOWER | {"num_attention_heads": 2, "image_size": 32, "patch_size": 16}
    text = TOWER | {"num_attention_heads": 2, "vocab_size": 50, "max_position_embeddings": 8}
    config = CLIPConfig(text_config=text, vision_config=vision, projection_dim=8)
    model = CLIPModel(config).eval()
    folder = tmp_path_factory.mktemp("clip")
    model.save_pretrained(folder)
    return folder, model


def test_clip_gives_what_transformers_gives(clip):
    folder, model = clip
    pictures = formula_pictures(32, 32)
    mean, std = torch.tensor(MEAN), torch.tensor(STD)
    pixels = ((pictures - mean) / std).movedim(-1, 1)
    with torch.no_grad():
        pooled = model.vision_model(pixel_values=pixels).pooler_output
        expected = model.visual_projection(pooled)
    torch.testing.assert_close(read_clip(folder, CPU)(pictures), expected, rtol=1e-5, atol=1e-6)


def test_all_figures_of_sets(clip, tmp_path):
    save_tensors(tmp_path / "lite0.safetensors", lite0_state())
    torch.save(inception_state(), tmp_path / "inception.pth")
    settings = PictureNetworkSettings(
        efficientnet_weights=tmp_path / "lite0.safetensors",
        inception_weights=tmp_path / "inception.pth",
        clip_folder=clip[0],
    )
    assert {"efficientnet_weights", "clip_folder/model.safetensors"} <= set(settings.digests)
    networks = PictureNetworks.load(settings, CPU)
    a = formula_pictures(48, 48)
    b = a.roll(7, 2)
    found = networks.compare_sets(a, b)
    assert set(found) == {"frechet_efficientnet", "fid", "cmmd", "clip_similarity"}
    assert set(found) <= set(IS_BETTER_HIGH)
    features = [networks.frechet["frechet_efficientnet"](pictures) for pictures in (a, b)]
    assert found["frechet_efficientnet"] == pytest.approx(frechet_distance(*features))
    assert found["cmmd"] == pytest.approx(cmmd(*(networks.clip(pictures) for pictures in (a, b))))
    same = networks.compare_sets(a, a.flip(0))
    assert same["fid"] == pytest.approx(0.0, abs=1e-6 * max(1.0, found["fid"]))
    assert same["clip_similarity"] < 100.0 - 1e-6  # the pairs are not equal
    assert networks.compare_sets(a, a)["clip_similarity"] == pytest.approx(100.0)
    # One picture has neither spread nor partners.
    assert set(networks.compare_sets(a[:1], a)) == {"cmmd"}


def test_lpips_is_named_after_its_network(tmp_path):
    files = {}
    for kind in ("vgg", "shift tolerant"):
        net = "vgg" if kind == "vgg" else "alex"
        files[kind] = tmp_path / f"{kind}.safetensors"
        save_tensors(files[kind], formula_weights(blank_state(net, kind)))
    settings = PictureNetworkSettings(
        lpips_weights=files["vgg"], st_lpips_weights=files["shift tolerant"]
    )
    networks = PictureNetworks.load(settings, CPU)
    a, b = formula_pictures(40, 40).split(1)
    found = networks.compare_pairs(a, b)
    assert set(found) == {"lpips", "st_lpips"}
    assert found["lpips"] == pytest.approx(float(networks.distances["lpips"](a, b)))
    swapped = PictureNetworkSettings(lpips_weights=files["shift tolerant"])
    with pytest.raises(InputError, match="give it as st_lpips_weights"):
        PictureNetworks.load(swapped, CPU)


def test_without_weights_there_are_no_figures():
    networks = PictureNetworks.load(PictureNetworkSettings(), CPU)
    a = formula_pictures(32, 32)
    assert networks.compare_sets(a, a) == {}
    assert networks.compare_pairs(a, a) == {}


@pytest.mark.parametrize("name", ["lpips_weights", "efficientnet_weights", "inception_weights"])
def test_missing_files_are_named(name, tmp_path):
    settings = PictureNetworkSettings(**{name: tmp_path / "gone.pth"})
    with pytest.raises(InputError, match=r"gone\.pth"):
        PictureNetworks.load(settings, CPU)


def test_weights_of_another_network_are_refused(tmp_path):
    file = tmp_path / "other.safetensors"
    save_tensors(file, {"fc.weight": torch.zeros(2)})
    for name, wanted in (("efficientnet_weights", "Lite0"), ("inception_weights", "FID")):
        with pytest.raises(InputError, match=rf"other\.safetensors.*{wanted}"):
            PictureNetworks.load(PictureNetworkSettings(**{name: file}), CPU)


def test_folders_that_hold_no_clip_are_refused(clip, tmp_path):
    def complaint(folder):
        with pytest.raises(InputError) as caught:
            PictureNetworks.load(PictureNetworkSettings(clip_folder=folder), CPU)
        return str(caught.value)

    assert "lacks config.json" in complaint(tmp_path)
    (tmp_path / "config.json").write_text("{}")
    (tmp_path / "pytorch_model.bin").write_bytes(b"")
    assert "lacks model.safetensors" in complaint(tmp_path)
    save_tensors(tmp_path / "model.safetensors", {"visual_projection.weight": torch.zeros(8, 16)})
    assert "no vision_config" in complaint(tmp_path)
    (tmp_path / "config.json").write_text("not json")
    assert "no JSON" in complaint(tmp_path)
    (tmp_path / "config.json").write_bytes((clip[0] / "config.json").read_bytes())
    assert "CLIP in" in complaint(tmp_path)


def test_installed_weights_are_found(monkeypatch, tmp_path):
    monkeypatch.undo()
    if not any(d.name == DISTRIBUTION for d in importlib.metadata.distributions()):
        pytest.skip("needs the extra `metrics`")
    settings = PictureNetworkSettings()
    assert settings.efficientnet_weights is not None
    networks = PictureNetworks.load(settings, CPU)
    noise = torch.rand(8, 64, 64, 3, generator=torch.Generator().manual_seed(0))
    smooth = torch.nn.functional.avg_pool2d(noise.movedim(-1, 1), 9, 1, 4).movedim(1, -1)
    encode = networks.frechet["frechet_efficientnet"]
    halves = frechet_distance(encode(noise[:4]), encode(noise[4:]))
    # Noise is nearer to noise than to its own blur.
    assert 3 * halves < frechet_distance(encode(noise[:4]), encode(smooth[:4]))
    assert np.isfinite(halves)
