"""Edits of materials as text: `roughness*0.5`, `basecolor=#aa3311`, `metallic=1`.

A small grammar, read by hand: CHANNEL OPERATOR OPERAND. Channels are `basecolor`, `roughness` and
`metallic`; operators `=`, `*`, `/`, `+`, `-`; an operand is a number, for basecolor also three
numbers (linear) separated by commas, or an sRGB colour as #rgb or #rrggbb.
"""

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.color import linear_from_srgb, luminance

CHANNELS = {"basecolor": 3, "roughness": 1, "metallic": 1}
GRAMMAR = re.compile(r"\s*([A-Za-z_]*)\s*([=*/+\-])\s*(\S.*?)\s*")
NUMBER = re.compile(r"\s*[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?\s*")
HEX_COLOUR = re.compile(r"#(?:[0-9a-fA-F]{3}|[0-9a-fA-F]{6})")
# Brightness of things that do not conduct, coal to fresh snow: sRGB 30 to 240.
# Source: Lagarde and de Rousiers 2014, "Moving Frostbite to PBR", section 3.1.
DIELECTRIC_ALBEDO = (0.013, 0.871)
METAL_ALBEDO = 0.40  # the darkest metals in use, sRGB 170; same source
SOLID = 0.999  # a region of one may miss it by rounding where it was resampled
NEITHER = (0.05, 0.95)  # metallic in between is a mixture that no material has

Images = dict[str, Float[Tensor, "*shape"]]


@dataclass(frozen=True)
class Edit:
    """One change of one channel.

    Attributes:
        channel: of `CHANNELS`.
        operator: one of = * / + -.
        operand: one number for all of the channel's components, or one for each.
        text: as it was written.
    """

    channel: str
    operator: str
    operand: tuple[float, ...]
    text: str

    def __str__(self) -> str:
        return self.text

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read an edit.

        Raises:
            ValueError: saying what was wanted and what came.
        """
        found = GRAMMAR.fullmatch(text)
        if found is None:
            raise ValueError(
                f"wanted an edit like roughness*0.5, basecolor=#aa3311 or metallic=1, got {text!r}"
            )
        channel, operator, operand = found.groups()
        if channel not in CHANNELS:
            near = difflib.get_close_matches(channel, CHANNELS, 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise ValueError(
                f"wanted one of {', '.join(CHANNELS)} in {text!r}, got {channel!r}{hint}"
            )
        numbers = _operand(operand, channel, text)
        if operator == "/" and 0.0 in numbers:
            raise ValueError(f"{text!r} divides by zero")
        return cls(channel, operator, numbers, text.strip())

    def apply(self, values: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """The edited channel, not yet limited to what can be."""
        operand = values.new_tensor(self.operand)
        match self.operator:
            case "=":
                return operand.expand_as(values).clone()
            case "*":
                return values * operand
            case "/":
                return values / operand
            case "+":
                return values + operand
            case _:
                return values - operand


def _operand(operand: str, channel: str, text: str) -> tuple[float, ...]:
    """Numbers of an operand, linear."""
    width = CHANNELS[channel]
    if operand.startswith("#"):
        if width != 3 or HEX_COLOUR.fullmatch(operand) is None:
            raise ValueError(
                f"wanted a colour like #aa3311 for basecolor, or a number, got {operand!r} "
                f"in {text!r}"
            )
        digits = operand[1:] if len(operand) == 7 else "".join(2 * d for d in operand[1:])
        srgb = torch.tensor([int(digits[i : i + 2], 16) / 255.0 for i in (0, 2, 4)])
        return tuple(linear_from_srgb(srgb.double()).tolist())
    parts = operand.split(",")
    # float() alone would also take 1_0, inf and digits of other scripts.
    plain = all(NUMBER.fullmatch(part) for part in parts)
    numbers = tuple(float(part) for part in parts) if plain else ()
    if len(numbers) not in (1, width) or not all(math.isfinite(n) for n in numbers):
        raise ValueError(
            f"wanted {'1 or 3 numbers' if width == 3 else 'a number'} for {channel}, "
            f"got {operand!r} in {text!r}"
        )
    return numbers


def scale_of(edits: Sequence[Edit], channel: str) -> tuple[float, ...] | None:
    """The number (or three) that all edits of a channel together multiply it by.

    None where they do more than that, or turn its sign.
    """
    scale = [1.0] * CHANNELS[channel]
    for edit in edits:
        if edit.channel != channel:
            continue
        if edit.operator not in "*/" or min(edit.operand) < 0.0:
            return None
        operand = edit.operand * (len(scale) // len(edit.operand))
        inverse = edit.operator == "/"
        scale = [s / o if inverse else s * o for s, o in zip(scale, operand, strict=True)]
    return tuple(scale)


def sets(edits: Sequence[Edit], channel: str) -> bool:
    """Whether the channel ends up the same everywhere, whatever it was."""
    return any(edit.channel == channel and edit.operator == "=" for edit in edits)


def edit_channel(
    channel: str,
    values: Float[Tensor, "*shape C"],
    edits: Sequence[Edit],
    region: Float[Tensor, "*region 1"] | None = None,
) -> tuple[Float[Tensor, "*shape C"], list[str]]:
    """All edits of one channel, one after the other, clamped to [0, 1] once and blended once.

    Clamping between them would make `*2` and then `*0.5` lose what lies above one half; blending
    between them would take less than its share of a soft region.

    Returns:
        The new values, and a message that counts the clamped ones.
    """
    mine = [edit for edit in edits if edit.channel == channel]
    wanted = values
    for edit in mine:
        wanted = edit.apply(wanted)
    limited = wanted.clamp(0.0, 1.0)
    outside = (wanted != limited).any(-1, keepdim=True)
    if region is not None:
        outside = outside & (region > 0.0)
        # Exact at both ends: pixels outside the region keep their bits.
        limited = torch.lerp(values, limited, region.expand_as(values))
    count = int(outside.sum()) if mine else 0
    texts = " ".join(str(edit) for edit in mine)
    return limited, [f"{texts}: {count} pixels clamped to [0, 1]"] if count else []


def apply_edits(
    images: Mapping[str, Float[Tensor, "*shape"]],
    edits: Sequence[Edit],
    region: Float[Tensor, "*region 1"] | None = None,
) -> tuple[Images, list[str]]:
    """Apply edits in order and keep the result within what can be; see `edit_channel`.

    Args:
        images: `basecolor`, `roughness`, `metallic`, channel last; others pass through.
        edits: in order.
        region: share of the edits that each pixel takes, in [0, 1]; None edits everything.

    Returns:
        All images, and messages: how many values were clamped to [0, 1], and what the edits made
        implausible.

    Raises:
        ValueError: the region is empty or of another size than the images.
    """
    region = None if region is None else _checked(region, images["roughness"])
    edited, notices = dict(images), []
    for channel in dict.fromkeys(edit.channel for edit in edits):
        edited[channel], told = edit_channel(channel, images[channel], edits, region)
        notices += told
    return edited, notices + implausible(images, edited, region)


def _checked(
    region: Float[Tensor, "*region 1"], like: Float[Tensor, "*shape 1"]
) -> Float[Tensor, "*shape 1"]:
    """The region at the size of the images."""
    if region.shape[-3:] != like.shape[-3:]:
        wanted, got = (f"{t.shape[-2]} x {t.shape[-3]}" for t in (like, region))
        raise ValueError(f"wanted a region of {wanted} pixels like the images, got {got}")
    if not bool((region > 0.0).any()):
        raise ValueError("the region is empty: no pixel would be edited")
    return region.expand_as(like)


def implausible(
    before: Mapping[str, Float[Tensor, "*shape"]],
    after: Mapping[str, Float[Tensor, "*shape"]],
    region: Float[Tensor, "*region 1"] | None = None,
) -> list[str]:
    """Messages about materials that do not exist and that the edit made; nothing is changed.

    What was like that before is the asset's own, edges between metal and paint for instance, and
    the soft border of a region mixes on purpose.
    """
    was, now = _oddities(before), _oddities(after)
    made = {text: found & ~was[text] for text, found in now.items()}
    if region is not None:
        made = {text: found & (region > SOLID) for text, found in made.items()}
    counts = {text: int(found.sum()) for text, found in made.items()}
    return [f"implausible: {count} pixels {text}" for text, count in counts.items() if count]


def _oddities(images: Mapping[str, Float[Tensor, "*shape"]]) -> dict[str, Tensor]:
    """Where materials are of a kind that does not exist."""
    metallic = images["metallic"]
    bright = luminance(images["basecolor"])
    mixed = (metallic > NEITHER[0]) & (metallic < NEITHER[1])
    insulator, metal = metallic <= NEITHER[0], metallic >= NEITHER[1]
    return {
        "are neither metal nor insulator (metallic between 0 and 1)": mixed,
        "are brighter than any insulator": insulator & (bright > DIELECTRIC_ALBEDO[1]),
        "are darker than any insulator": insulator & (bright < DIELECTRIC_ALBEDO[0]),
        "are darker than any metal": metal & (bright < METAL_ALBEDO),
    }
