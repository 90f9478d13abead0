"""Settings of the loss that compares pictures instead of pixels, which phases 1 and 2 share."""

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, NonNegativeFloat, PositiveInt, model_validator

from stages.installed import SHIFT_TOLERANT_LPIPS, installed_weights
from stages.settings.base import FileReadingConfig


class PerceptualSettings(FileReadingConfig):
    """How renders are compared with views as pictures."""

    perceptual: Literal["none", "auto", "dssim", "lpips", "st_lpips"] = "none"
    """Distance of pictures: `dssim` (structural similarity), `lpips` with weights of one's own,
    `st_lpips` (shift-tolerant) with one's own or those of stlpips-pytorch, if it is installed.
    `auto` takes weights that are given, else the installed ones, else `dssim`."""
    perceptual_weights: Path | None = None
    """State of `lpips.LPIPS(net='alex')` or of another of its networks, backbone included
    (.safetensors, or .pth as torch.save writes it)."""
    perceptual_size: Annotated[int, Field(ge=32)] = 64
    """Side of the square that is compared, pixels."""
    perceptual_every: PositiveInt = 1
    """Steps from one comparison to the next; the weight makes up for those without."""
    perceptual_weight: NonNegativeFloat = 1.0
    """Of the distance."""

    @model_validator(mode="before")
    @classmethod
    def _find_installed_weights(cls, given: Any) -> Any:
        """Name the installed weights where they are meant, so that they are digested too."""
        if not isinstance(given, dict) or given.get("perceptual") not in ("auto", "st_lpips"):
            return given
        if given.get("perceptual_weights") is None:
            found = installed_weights(*SHIFT_TOLERANT_LPIPS)
            return given if found is None else given | {"perceptual_weights": found}
        return given

    @model_validator(mode="after")
    def _weights_are_used(self) -> Self:
        """A network needs weights, and weights a network."""
        if self.perceptual == "lpips" and self.perceptual_weights is None:
            raise ValueError(
                "perceptual lpips wants perceptual_weights: the state of lpips.LPIPS(net='alex')"
            )
        if self.perceptual == "st_lpips" and self.perceptual_weights is None:
            package = SHIFT_TOLERANT_LPIPS[0]
            raise ValueError(
                f"perceptual st_lpips wants the weights in {package}: pip install --no-deps "
                f"{package}, or give perceptual_weights"
            )
        if self.perceptual in ("none", "dssim") and self.perceptual_weights is not None:
            raise ValueError(f"perceptual {self.perceptual} uses no weights: leave out one of both")
        return self
