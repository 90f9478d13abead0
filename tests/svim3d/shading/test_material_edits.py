import pytest
import torch

from svim3d.color import linear_from_srgb
from svim3d.shading.material_edits import Edit, apply_edits, scale_of

ORANGE = tuple(linear_from_srgb(torch.tensor([0xAA, 0x33, 0x11]).double() / 255).tolist())


def images(size: int = 4) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return {
        "basecolor": torch.rand(1, size, size, 3, generator=generator) * 0.4 + 0.3,
        "roughness": torch.rand(1, size, size, 1, generator=generator) * 0.4 + 0.3,
        "metallic": torch.zeros(1, size, size, 1),
    }


@pytest.mark.parametrize(
    ("text", "channel", "operator", "operand"),
    [
        ("roughness*0.5", "roughness", "*", (0.5,)),
        ("  roughness  =  .3 ", "roughness", "=", (0.3,)),
        ("metallic=1", "metallic", "=", (1.0,)),
        ("roughness-1e-1", "roughness", "-", (0.1,)),
        ("roughness/2", "roughness", "/", (2.0,)),
        ("roughness=-1", "roughness", "=", (-1.0,)),
        ("basecolor=#aa3311", "basecolor", "=", ORANGE),
        ("basecolor*#A31", "basecolor", "*", ORANGE),
        ("basecolor=0.2, 0.1,0.05", "basecolor", "=", (0.2, 0.1, 0.05)),
        ("basecolor+0.05", "basecolor", "+", (0.05,)),
    ],
)
def test_edits_are_read(text, channel, operator, operand):
    edit = Edit.parse(text)
    assert (edit.channel, edit.operator) == (channel, operator)
    assert edit.operand == pytest.approx(operand)
    assert Edit.parse(str(edit)) == edit


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "wanted an edit like"),
        ("roughness", "wanted an edit like"),
        ("roughness=", "wanted an edit like"),
        ("roughness^2", "wanted an edit like"),
        ("rougness*2", "did you mean roughness"),
        ("normal=1", "wanted one of basecolor, roughness, metallic"),
        ("roughness=nan", "wanted a number for roughness"),
        ("roughness=1_0", "wanted a number for roughness"),
        ("roughness=inf", "wanted a number for roughness"),
        ("roughness=1e999", "wanted a number for roughness"),
        ("roughness=1,2,3", "wanted a number for roughness"),
        ("roughness=#fff", "wanted a colour like #aa3311 for basecolor"),
        ("basecolor=#ff", "wanted a colour like"),
        ("basecolor=#gggggg", "wanted a colour like"),
        ("basecolor=1,2", "wanted 1 or 3 numbers"),
        ("basecolor=red", "wanted 1 or 3 numbers"),
        ("roughness=__import__('os')", "wanted a number"),
        ("roughness/0", "divides by zero"),
    ],
)
def test_anything_else_is_refused(text, said):
    with pytest.raises(ValueError, match=said):
        Edit.parse(text)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("roughness=0.25", lambda r: torch.full_like(r, 0.25)),
        ("roughness*0.5", lambda r: r * 0.5),
        ("roughness/2", lambda r: r * 0.5),
        ("roughness+0.1", lambda r: r + 0.1),
        ("roughness-0.1", lambda r: r - 0.1),
    ],
)
def test_each_operator_does_what_it_says(text, expected):
    before = images()
    after, notices = apply_edits(before, [Edit.parse(text)])
    torch.testing.assert_close(after["roughness"], expected(before["roughness"]))
    assert after["basecolor"] is before["basecolor"]
    assert notices == []


def test_edits_follow_each_other():
    before = images()
    after, _ = apply_edits(before, [Edit.parse("roughness=0.5"), Edit.parse("roughness*0.5")])
    assert torch.equal(after["roughness"], torch.full_like(before["roughness"], 0.25))


def test_values_stay_within_what_can_be_and_are_counted():
    before = images()
    before["roughness"][0, 0] = 0.9
    after, notices = apply_edits(before, [Edit.parse("roughness+0.25")])
    assert float(after["roughness"].max()) == 1.0
    assert notices == ["roughness+0.25: 4 pixels clamped to [0, 1]"]


def test_soft_regions_blend():
    before, region = images(), torch.zeros(4, 4, 1)
    region[0, 0], region[0, 1] = 1.0, 0.25
    after, _ = apply_edits(before, [Edit.parse("basecolor=#aa3311")], region)
    colour = torch.tensor(ORANGE).float()
    torch.testing.assert_close(after["basecolor"][0, 0, 0], colour)
    blend = 0.75 * before["basecolor"][0, 0, 1] + 0.25 * colour
    torch.testing.assert_close(after["basecolor"][0, 0, 1], blend)
    assert torch.equal(after["basecolor"][0, 1:], before["basecolor"][0, 1:])


def test_several_edits_are_limited_and_blended_once():
    before = images() | {"roughness": torch.full((1, 4, 4, 1), 0.8)}
    doubled, notices = apply_edits(before, [Edit.parse("roughness*2"), Edit.parse("roughness*0.5")])
    torch.testing.assert_close(doubled["roughness"], before["roughness"])
    assert notices == []
    edits = [Edit.parse("roughness=0.5"), Edit.parse("roughness*0.5")]
    soft, _ = apply_edits(before, edits, torch.full((4, 4, 1), 0.5))
    assert float(soft["roughness"].max()) == pytest.approx(0.5 * 0.8 + 0.5 * 0.25)


def test_regions_keep_bits_where_they_are_zero_and_edit_fully_where_they_are_one():
    before = images(64)
    region = (torch.rand(64, 64, 1, generator=torch.Generator().manual_seed(1)) > 0.5).float()
    everywhere, _ = apply_edits(before, [Edit.parse("basecolor*1.3")])
    after, _ = apply_edits(before, [Edit.parse("basecolor*1.3")], region)
    expected = torch.where(region > 0, everywhere["basecolor"], before["basecolor"])
    assert torch.equal(after["basecolor"], expected)


def test_what_was_implausible_before_is_not_the_edit_s_fault():
    before = images() | {"metallic": torch.full((1, 4, 4, 1), 0.5)}
    assert apply_edits(before, [Edit.parse("basecolor*0.9")])[1] == []


@pytest.mark.parametrize(
    ("texts", "scale"),
    [
        (["roughness*0.5", "metallic=1", "roughness/4"], (0.125,)),
        (["metallic=1"], (1.0,)),
        (["roughness*-1"], None),
        (["roughness*0.5", "roughness+0.1"], None),
    ],
)
def test_plain_scales_are_told_apart(texts, scale):
    assert scale_of([Edit.parse(text) for text in texts], "roughness") == scale


def test_regions_that_cannot_be_used_are_refused():
    with pytest.raises(ValueError, match="the region is empty"):
        apply_edits(images(), [Edit.parse("metallic=1")], torch.zeros(4, 4, 1))
    with pytest.raises(ValueError, match=r"wanted a region of 4 x 4 pixels .* got 3 x 5"):
        apply_edits(images(), [Edit.parse("metallic=1")], torch.ones(5, 3, 1))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("metallic=0.5", "16 pixels are neither metal nor insulator"),
        ("basecolor=0.95", "16 pixels are brighter than any insulator"),
        ("basecolor=0.001", "16 pixels are darker than any insulator"),
    ],
)
def test_implausible_materials_are_told_but_not_changed(text, said):
    after, notices = apply_edits(images(), [Edit.parse(text)])
    assert any(said in notice for notice in notices)
    edit = Edit.parse(text)
    assert float(after[edit.channel].mean()) == pytest.approx(edit.operand[0], rel=1e-4)
