"""Pictures as sets: features of shown and true pictures, and distances of many objects' features.

Pictures lie on white, as photos of products do. Features are kept object by object, so that a
suite's sets are compared without any picture in memory; both sides hold the same views, so that
they are of equal size.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from stages.picture_networks import CLIP
from stages.scores_artifact import FEATURES
from svim3d.color import srgb_from_linear
from svim3d.io.picture_networks import Encoder
from svim3d.io.weights import load_tensors
from svim3d.metrics.features import clip_similarity, cmmd, frechet_distance

SHOWN, TRUE = "shown", "true"
MIN_PICTURES = 2  # a single one has no spread
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


def set_figures(folders: Sequence[Path]) -> dict[str, dict[str, float]]:
    """Distances of the sets that all objects' pictures make together, by subject and figure.

    A figure is called after its network: `fid` is Inception's, `frechet_efficientnet` that of
    EfficientNet-Lite0, `cmmd` and `clip_similarity` are CLIP's. Fewer than two pictures have none.

    Args:
        folders: of scores.
    """
    held: dict[str, list[Tensor]] = {}
    for file in (folder / FEATURES for folder in folders):
        for name, rows in (load_tensors(file) if file.is_file() else {}).items():
            held.setdefault(name, []).append(rows)
    figures: dict[str, dict[str, float]] = {}
    for name in [n for n in held if n.endswith(f"/{SHOWN}")]:
        subject, network, _ = name.split("/")
        shown, true = (torch.cat(held[f"{subject}/{network}/{s}"]) for s in (SHOWN, TRUE))
        found = figures.setdefault(subject, {})
        if len(shown) < MIN_PICTURES:
            continue
        if network == CLIP:
            found["cmmd"] = cmmd(shown, true)
            found["clip_similarity"] = clip_similarity(shown, true)
        else:
            found[network] = frechet_distance(shown, true)
    return figures
