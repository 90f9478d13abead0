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
HEX_COLOUR = re.compile(r"#(?:[0-9a-fA-F]{3}|[0-9a-fA-F]{6})")
# Brightness of things that do not conduct, coal to fresh snow: sRGB 30 to 240.
# Source: Lagarde and de Rousiers 2014, "Moving Frostbite to PBR", section 3.1.
DIELECTRIC_ALBEDO = (0.013, 0.871)
METAL_ALBEDO = 0.40  # the darkest metals in use, sRGB 170; same source
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
    try:
        numbers = tuple(float(part) for part in operand.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) not in (1, width) or not all(math.isfinite(n) for n in numbers):
        raise ValueError(
            f"wanted {'1 or 3 numbers' if width == 3 else 'a number'} for {channel}, "
            f"got {operand!r} in {text!r}"
        )
    return numbers


def apply_edits(
    images: Mapping[str, Float[Tensor, "*shape"]],
    edits: Sequence[Edit],
    region: Float[Tensor, "*region 1"] | None = None,
) -> tuple[Images, list[str]]:
    """Apply edits one after the other and keep the result within what can be.

    Args:
        images: `basecolor`, `roughness`, `metallic`, channel last; others pass through.
        edits: in order.
        region: share of the edit that each pixel takes, in [0, 1]; None edits everything.

    Returns:
        All images, and messages: how many values were clamped to [0, 1], and what is implausible.

    Raises:
        ValueError: the region is empty or of another size than the images.
    """
    region = _checked(region, images["roughness"])
    edited, notices = dict(images), []
    for edit in edits:
        before = edited[edit.channel]
        after = edit.apply(before)
        limited = after.clamp(0.0, 1.0)
        clamped = int(((after != limited) & (region > 0.0)).any(-1).sum())
        if clamped:
            notices.append(f"{edit}: {clamped} pixels clamped to [0, 1]")
        edited[edit.channel] = before + region * (limited - before)
    touched = {edit.channel for edit in edits}
    if touched & {"basecolor", "metallic"}:
        notices += _implausible(edited, region > 0.5)
    return edited, notices


def _checked(
    region: Float[Tensor, "*region 1"] | None, like: Float[Tensor, "*shape 1"]
) -> Float[Tensor, "*shape 1"]:
    """The region at the size of the images, everything where there is none."""
    if region is None:
        return torch.ones_like(like)
    if region.shape[-3:] != like.shape[-3:]:
        wanted, got = (f"{t.shape[-2]} x {t.shape[-3]}" for t in (like, region))
        raise ValueError(f"wanted a region of {wanted} pixels like the images, got {got}")
    if not bool((region > 0.0).any()):
        raise ValueError("the region is empty: no pixel would be edited")
    return region.expand_as(like)


def _implausible(images: Images, where: Tensor) -> list[str]:
    """Messages about materials that do not exist; nothing is changed."""
    metallic = images["metallic"]
    bright = luminance(images["basecolor"])
    mixed = (metallic > NEITHER[0]) & (metallic < NEITHER[1])
    insulator, metal = metallic <= NEITHER[0], metallic >= NEITHER[1]
    findings = {
        "are neither metal nor insulator (metallic between 0 and 1)": mixed,
        "are brighter than any insulator": insulator & (bright > DIELECTRIC_ALBEDO[1]),
        "are darker than any insulator": insulator & (bright < DIELECTRIC_ALBEDO[0]),
        "are darker than any metal": metal & (bright < METAL_ALBEDO),
    }
    counts = {text: int((found & where).sum()) for text, found in findings.items()}
    return [f"implausible: {count} pixels {text}" for text, count in counts.items() if count]
