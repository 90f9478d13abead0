"""Weights that the tests make, in the files that users have them in, and distances by them."""

import numpy as np
import pytest
import torch
from feature_weights import formula_pictures, inception_state, lite0_state
from lpips_weights import blank_state, formula_weights
from transformers import CLIPConfig, CLIPModel

from stages.errors import InputError
from stages.installed import EFFICIENTNET_LITE0, installed_weights
from stages.pair_distance import read_distance
from stages.picture_networks import read_encoders
from stages.picture_sets import PictureSets
from stages.scores_artifact import FEATURES
from stages.set_figures import set_figures
from svim3d.color import linear_from_srgb
from svim3d.io.picture_networks import read_clip
from svim3d.io.weights import save_tensors
from svim3d.metrics.features import cmmd, frechet_distance

CPU = torch.device("cpu")
TOWER = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 2}
MEAN, STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)


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


def figures(folder, encoders, shown, true):
    """Distances of two sets of display-encoded pictures, by way of the file of their features."""
    sets = PictureSets(encoders)
    mask = torch.ones(*shown.shape[:3], 1)
    sides = [{"radiance": linear_from_srgb(one), "mask": mask} for one in (shown, true)]
    sets.add("views", *sides, range(len(shown)), (1.0, 1.0))
    folder.mkdir()
    save_tensors(folder / FEATURES, sets.features())
    return set_figures([folder])["views"]


def test_all_figures_of_sets(clip, tmp_path):
    lite0, inception = tmp_path / "lite0.safetensors", tmp_path / "inception.pth"
    save_tensors(lite0, lite0_state())
    torch.save(inception_state(), inception)
    encoders = read_encoders(lite0, inception, clip[0], CPU)
    a = formula_pictures(48, 48)
    b = a.roll(7, 2)
    found = figures(tmp_path / "ab", encoders, a, b)
    assert set(found) == {"frechet_efficientnet", "fid", "cmmd", "clip_similarity"}
    features = [encoders["frechet_efficientnet"](pictures) for pictures in (a, b)]
    assert found["frechet_efficientnet"] == pytest.approx(frechet_distance(*features), rel=1e-3)
    expected = cmmd(*(encoders["clip"](pictures) for pictures in (a, b)))
    assert found["cmmd"] == pytest.approx(expected, rel=1e-3)
    # The set is the same in any order, its pairs are not.
    turned = figures(tmp_path / "turned", encoders, a, a.flip(0))
    assert turned["fid"] < 1e-6 * found["fid"]
    assert turned["cmmd"] == pytest.approx(0.0, abs=1e-6)
    assert turned["clip_similarity"] < 100.0 - 1e-6
    same = figures(tmp_path / "same", {"clip": encoders["clip"]}, a, a)
    assert same["clip_similarity"] == pytest.approx(100.0)
    # One picture has no spread.
    assert figures(tmp_path / "single", encoders, a[:1], b[:1]) == {}


def test_lpips_is_named_after_its_network(tmp_path):
    a, b = formula_pictures(40, 40).split(1)
    seen = {}
    for name, net, kind in (("lpips", "vgg", "vgg"), ("st_lpips", "alex", "shift tolerant")):
        file = tmp_path / f"{kind}.safetensors"
        save_tensors(file, formula_weights(blank_state(net, kind)))
        distance = read_distance(file)
        assert distance is not None and distance.name == name
        with torch.no_grad():
            seen[name] = float(distance.distance(a, b))
    assert seen["lpips"] != seen["st_lpips"] > 0.0


def test_without_weights_there_are_no_figures(tmp_path):
    assert read_distance(None) is None
    a = formula_pictures(32, 32)
    assert set_figures([tmp_path]) == {}
    sets = PictureSets(read_encoders(None, None, None, CPU))
    one = {"radiance": a, "mask": torch.ones(*a.shape[:3], 1)}
    sets.add("views", one, one, range(len(a)), (1.0, 1.0))
    assert sets.features() == {}


@pytest.mark.parametrize("place", [0, 1])
def test_missing_files_are_named(place, tmp_path):
    files = [None, None]
    files[place] = tmp_path / "gone.pth"
    with pytest.raises(InputError, match=r"gone\.pth"):
        read_encoders(*files, None, CPU)


def test_missing_file_of_a_distance_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"gone\.pth"):
        read_distance(tmp_path / "gone.pth")


def test_weights_of_another_network_are_refused(tmp_path):
    file = tmp_path / "other.safetensors"
    save_tensors(file, {"fc.weight": torch.zeros(2)})
    for files, wanted in (((file, None), "Lite0"), ((None, file), "FID")):
        with pytest.raises(InputError, match=rf"other\.safetensors.*{wanted}"):
            read_encoders(*files, None, CPU)


def test_folders_that_hold_no_clip_are_refused(clip, tmp_path):
    def complaint(folder):
        with pytest.raises(InputError) as caught:
            read_encoders(None, None, folder, CPU)
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


def test_installed_weights_are_found():
    assert installed_weights("no-such-distribution", "file") is None
    file = installed_weights(*EFFICIENTNET_LITE0)
    if file is None:
        pytest.skip("needs the extra `metrics`")
    encode = read_encoders(file, None, None, CPU)["frechet_efficientnet"]
    noise = torch.rand(8, 64, 64, 3, generator=torch.Generator().manual_seed(0))
    smooth = torch.nn.functional.avg_pool2d(noise.movedim(-1, 1), 9, 1, 4).movedim(1, -1)
    halves = frechet_distance(encode(noise[:4]), encode(noise[4:]))
    # Noise is nearer to noise than to its own blur.
    assert 3 * halves < frechet_distance(encode(noise[:4]), encode(smooth[:4]))
    assert np.isfinite(halves)
