"""The loss on pictures: whose weights it takes, and that they are part of an artifact's key."""

import pytest
import torch
from lpips_weights import blank_state, formula_weights
from pydantic import ValidationError
from sphere_orbit import sphere_cameras, sphere_images

from stages.artifacts import MaterialViews
from stages.errors import InputError
from stages.perceptual_terms import PerceptualTerm
from stages.settings import perceptual as settings
from stages.settings.dmtet import DmtetConfig
from stages.settings.nerf import NerfConfig
from svim3d.losses.lpips import Lpips
from svim3d.render.perceptual import structural_distance

CAMERAS = sphere_cameras(views=3, size=32)
VIEWS = MaterialViews(cameras=CAMERAS, reference=2, **sphere_images(CAMERAS))
_, PLANES = VIEWS.premultiplied(32)


@pytest.fixture
def weights(tmp_path):
    """A file of each network."""

    def write(kind):
        file = tmp_path / f"{kind}.pth"
        torch.save(formula_weights(blank_state("alex", kind)), file)
        return file

    return write


@pytest.fixture
def no_extra(monkeypatch):
    monkeypatch.setattr(settings, "SHIFT_TOLERANT_LPIPS", ("no-such-distribution", "file"))


@pytest.fixture
def extra(tmp_path, monkeypatch, weights):
    """An installed distribution that cannot be imported."""
    about = tmp_path / "stlpips_pytorch-0.0.2.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Name: stlpips-pytorch\nVersion: 0.0.2\n")
    monkeypatch.syspath_prepend(tmp_path)
    file = tmp_path / settings.SHIFT_TOLERANT_LPIPS[1]
    file.parent.mkdir(parents=True)
    (tmp_path / "stlpips_pytorch" / "__init__.py").write_text("raise RuntimeError")
    weights("shift tolerant").rename(file)
    return file


def term(config, ctx):
    return PerceptualTerm.of(CAMERAS, PLANES, config, ctx)


def test_without_it_nothing_is_compared(make_context):
    assert term(NerfConfig(), make_context("nerf")) is None
    assert term(NerfConfig(perceptual="dssim", perceptual_weight=0.0), make_context("nerf")) is None


def test_auto_takes_given_weights_then_the_extra_then_structure(extra, weights, make_context):
    given = NerfConfig(perceptual="auto", perceptual_weights=weights("alex"))
    distance = term(given, make_context("nerf")).distance
    assert isinstance(distance, Lpips) and not distance.is_shift_tolerant
    distance = term(NerfConfig(perceptual="auto"), make_context("nerf")).distance
    assert isinstance(distance, Lpips) and distance.is_shift_tolerant


def test_auto_without_any_weights_says_so(no_extra, make_context):
    ctx = make_context("nerf")
    assert term(NerfConfig(perceptual="auto"), ctx).distance is structural_distance
    assert [event["kind"] for event in ctx.events] == ["no_lpips"]


def test_what_was_asked_for_is_not_replaced(weights, make_context):
    other = DmtetConfig(perceptual="st_lpips", perceptual_weights=weights("alex"))
    with pytest.raises(InputError, match="holds the plain network; choose the other one"):
        term(other, make_context("dmtet"))
    other = NerfConfig(perceptual="lpips", perceptual_weights=weights("shift tolerant"))
    with pytest.raises(InputError, match="holds the shift-tolerant network"):
        term(other, make_context("nerf"))
    missing = NerfConfig(perceptual="lpips", perceptual_weights="nowhere.safetensors")
    with pytest.raises(InputError, match="perceptual_weights: there is no file"):
        term(missing, make_context("nerf"))


def test_settings_that_cannot_be_met_are_refused(no_extra):
    with pytest.raises(ValidationError, match="lpips wants perceptual_weights"):
        NerfConfig(perceptual="lpips")
    with pytest.raises(ValidationError, match="pip install --no-deps no-such-distribution"):
        DmtetConfig(perceptual="st_lpips")
    with pytest.raises(ValidationError, match="dssim uses no weights"):
        DmtetConfig(perceptual="dssim", perceptual_weights="alex.pth")


def test_weights_are_part_of_the_key_by_their_content(weights):
    file = weights("alex")
    before = NerfConfig(perceptual="lpips", perceptual_weights=file).digests
    file.write_bytes(file.read_bytes() + b"more")
    after = NerfConfig(perceptual="lpips", perceptual_weights=file).digests
    assert list(before) == list(after) == ["perceptual_weights"]
    assert before != after


def test_installed_weights_are_part_of_the_key_only_where_they_are_used(extra):
    used = NerfConfig(perceptual="st_lpips")
    assert used.perceptual_weights == extra
    assert list(used.digests) == ["perceptual_weights"]
    assert NerfConfig().digests == NerfConfig(perceptual="dssim").digests == {}
    extra.unlink()
    assert NerfConfig(perceptual="auto").perceptual_weights is None
