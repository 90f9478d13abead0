"""Networks against what their reference implementations gave for the same weights and pictures.

The figures were printed by efficientnet-lite-pytorch 0.1.0 and pytorch-fid 0.3.0 (on torchvision
0.29): ours were equal to the last bit.
"""

import pytest
import torch
from feature_weights import formula_pictures, inception_state, lite0_state

from svim3d.metrics.efficientnet import EfficientNetLite0
from svim3d.metrics.inception import FidInception

LITE0 = [
    [2.958216428756714, 0.0, 1.598862648010254, 1.5125789642333984, 2.388251781463623],
    [2.8179149627685547, 0.0, 1.6202657222747803, 1.3157644271850586, 1.665999412536621],
]
INCEPTION = [
    [0.0, 0.15455226600170135, 0.11451533436775208, 0.5605471134185791],
    [0.0, 0.17009952664375305, 0.16752463579177856, 0.6799681186676025],
]


@pytest.fixture(scope="module")
def lite0():
    return lite0_state()


@pytest.fixture(scope="module")
def inception():
    return inception_state()


def test_efficientnet_is_the_reference_one(lite0):
    found = EfficientNetLite0.of(lite0)(formula_pictures(224, 224))
    assert found.shape == (2, 1280)
    torch.testing.assert_close(found[:, ::256], torch.tensor(LITE0), rtol=1e-4, atol=1e-5)


def test_inception_is_the_reference_one(inception):
    found = FidInception.of(inception)(formula_pictures(128, 96))
    assert found.shape == (2, 2048)
    torch.testing.assert_close(found[:, ::512], torch.tensor(INCEPTION), rtol=1e-3, atol=1e-5)


def test_batches_give_the_same_features(lite0, monkeypatch):
    network, pictures = EfficientNetLite0.of(lite0), formula_pictures(40, 60)
    whole = network(pictures)
    monkeypatch.setattr("svim3d.metrics.efficientnet.BATCH", 1)
    torch.testing.assert_close(network(pictures), whole, rtol=1e-4, atol=1e-5)


def test_other_networks_are_refused(lite0, inception):
    with pytest.raises(ValueError, match="one without _conv_stem"):
        EfficientNetLite0.of(inception)
    with pytest.raises(ValueError, match="a larger network"):
        EfficientNetLite0.of(lite0 | {"_blocks.16._project_conv.weight": torch.zeros(1)})
    with pytest.raises(ValueError, match=r"without Conv2d_1a_3x3\.conv\.weight"):
        FidInception.of(lite0)
    with pytest.raises(ValueError, match="no FID"):
        FidInception.of(inception | {"fc.bias": torch.zeros(1000)})
