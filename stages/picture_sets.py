"""Features of shown and true pictures, for `stages.set_figures` to compare as sets.

Pictures lie on white, as photos of products do; both sides hold the same views, so that sets are of
equal size.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from stages.set_figures import SHOWN, TRUE
from svim3d.color import srgb_from_linear
from svim3d.io.picture_networks import Encoder

BATCH = 16  # pictures that are encoded at once


class PictureSets:
    """Features of one object's pictures, by subject and network."""

    def __init__(self, encoders: Mapping[str, Encoder]) -> None:
        self._encoders = encoders
        self._rows: dict[str, list[Tensor]] = {}

    def add(
        self,
        subject: str,
        shown: Mapping[str, Tensor],
        truth: Mapping[str, Tensor],
        views: Sequence[int],
        gains: tuple[float, float],
    ) -> None:
        """Encode some views of both sides.

        Args:
            subject: whose pictures are shown.
            shown: radiance (premultiplied) and mask.
            truth: the same.
            views: which of them.
            gains: exposure of the shown and of the true radiance.
        """
        for side, images, gain in zip((SHOWN, TRUE), (shown, truth), gains, strict=True):
            for start in range(0, len(views), BATCH) if self._encoders else ():
                part = list(views[start : start + BATCH])
                pictures = _on_white(images["radiance"][part] * gain, images["mask"][part])
                for name, encode in self._encoders.items():
                    rows = self._rows.setdefault(f"{subject}/{name}/{side}", [])
                    rows.append(encode(pictures).float().cpu())

    def features(self) -> dict[str, Tensor]:
        """One row a picture, by subject, network and side."""
        return {name: torch.cat(rows) for name, rows in self._rows.items()}


def _on_white(radiance: Tensor, mask: Tensor) -> Tensor:
    return srgb_from_linear((radiance + (1.0 - mask)).clamp(0.0, 1.0))
