"""Checkpoints: kinds are told apart, and nothing is loaded that does not fit to the last tensor."""

import pytest
import single_file
import torch
from torch import nn

from svim3d.diffusion.checkpoint import Kind, detect, fill, require_cameras, spec_of

FIRST, LAST, TOLD = (
    single_file.UNET + name
    for name in ("input_blocks.0.0.weight", "out.2.weight", "label_emb.0.0.weight")
)


def network():
    with torch.device("meta"):
        return nn.Sequential(nn.Linear(2, 3), nn.Linear(3, 5))


def weights():
    return {n: torch.zeros(v.shape) for n, v in network().state_dict().items()}


@pytest.mark.parametrize(
    ("widths", "kind"),
    [
        (single_file.Widths(), Kind.SV3D_P),
        (single_file.Widths(told=256), Kind.SV3D_U),
        (single_file.Widths(told=768), Kind.SVD),
        (single_file.Widths(inputs=20, outputs=16), Kind.SVIM3D),
        (single_file.SMALL, Kind.SV3D_P),
    ],
)
def test_kinds_are_told_by_shapes(widths, kind):
    assert detect(single_file.whole(widths)) is kind


@pytest.mark.parametrize(
    ("shapes", "complaint"),
    [
        ({}, "found 0 tensors such as none at all"),
        ({"a.b": (1,)}, "found 1 tensors such as a.b$"),
        ({"conv_in.weight": (320, 20, 3, 3)}, "one network of a model folder: name the folder"),
        ({TOLD: (1280, 2816), FIRST: (320, 4, 3, 3), LAST: (4, 320, 3, 3)}, "got 2816 numbers"),
        ({TOLD: (1280, 1280), FIRST: (320, 9, 3, 3), LAST: (4, 320, 3, 3)}, "9 and 4 channels"),
    ],
)
def test_other_files_are_refused(shapes, complaint):
    with pytest.raises(ValueError, match=complaint):
        detect(shapes)


def test_models_without_cameras_are_named():
    with pytest.raises(ValueError, match=r"this is SV3D_u, .* wanted sv3d_p\.safetensors"):
        require_cameras(Kind.SV3D_U)
    with pytest.raises(ValueError, match="this is Stable Video Diffusion"):
        require_cameras(Kind.SVD)
    require_cameras(Kind.SV3D_P)
    require_cameras(Kind.SVIM3D)


def test_filling_takes_the_very_tensors():
    net, given = network(), weights()
    fill(net, given, "net")
    assert net[0].weight.data_ptr() == given["0.weight"].data_ptr()
    assert not any(p.is_meta for p in net.parameters())


def test_all_faults_are_told_at_once_and_nothing_is_loaded():
    net, given = network(), weights()
    del given["0.bias"]
    given |= {f"extra.{i}": torch.zeros(1) for i in range(5)}
    given["1.weight"] = torch.zeros(3, 5)
    with pytest.raises(ValueError) as caught:
        fill(net, given, "net")
    assert str(caught.value) == (
        "net: the tensors do not fit the network: 1 missing (0.bias); "
        "5 unexpected (extra.0, extra.1, extra.2, ...); "
        "1 of another shape (1.weight (3, 5) for (5, 3))"
    )
    assert net[0].weight.is_meta


def test_a_file_without_a_size_telling_tensor_names_it():
    shapes = {"unet": {"conv_in.weight": (4,)}, "autoencoder": {}, "image_encoder": {}}
    with pytest.raises(ValueError, match=r"conv_in\.weight is wanted, but its shape is \(4,\)"):
        spec_of("broken", shapes)
    del shapes["unet"]["conv_in.weight"]
    with pytest.raises(ValueError, match=r"unet: the size of conv_in\.weight .* missing"):
        spec_of("broken", shapes)
