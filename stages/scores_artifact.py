"""Scores of an asset against the truth: what evaluations keep, and make tables of."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Self

from torch import Tensor

from svim3d.io.weights import load_tensors, save_tensors

REFERENCE, GIVEN, NOVEL, RELIT = "reference", "given", "novel", "relit"
DRAWN, ASSET, TRUE = "drawn", "asset", "true views"
SCORES, FEATURES = "scores.json", "features.safetensors"

Figures = dict[str, float]


@dataclass(frozen=True)
class ViewScore:
    """Figures of one view.

    Attributes:
        part: `reference` (the photo's view), `given` (the other training views), `novel` (test
            views under the same light) or `relit` (under another).
        subject: `drawn`, `asset` or `true views`.
        light: of the truth, by name.
        azimuth_deg: of the camera, from the photo's, in [0, 360).
        figures: by name.
    """

    part: str
    subject: str
    light: str
    azimuth_deg: float
    figures: Figures


@dataclass(frozen=True)
class TableScores:
    """All figures of an asset.

    Attributes:
        views: of each view and subject.
        surface: Chamfer distance, F-scores, consistency of normals, overlap of volumes; empty where
            nobody knows the true surface.
        agreement: by subject, of views with each other where a surface shows the same points to
            neighbours: `apart` and `rgb_apart`, mean differences of sRGB basecolor and pictures,
            and `compared`, the share of pixels that were. Drawn views by the asset's surface, true
            ones by the true one; empty where nothing was drawn.
        framing: scale of the asset in the truth's frame.
        capture: `depth` and `shape` by Stanford-ORB's script, in its units; empty elsewhere.
        features: of shown and true pictures by networks that compare sets, one row a picture;
            see `stages.set_figures`.
    """

    views: list[ViewScore]
    surface: Figures
    agreement: dict[str, Figures]
    framing: float
    capture: Figures = field(default_factory=dict)
    features: Mapping[str, Tensor] = field(default_factory=dict)

    def save(self, folder: Path) -> None:
        """Write `scores.json`, and `features.safetensors` where there are some."""
        page = {
            "views": [asdict(view) for view in self.views],
            "surface": self.surface,
            "agreement": self.agreement,
            "framing": self.framing,
            "capture": self.capture,
        }
        (folder / SCORES).write_text(json.dumps(page, indent=1))
        if self.features:
            save_tensors(folder / FEATURES, dict(self.features))

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read them."""
        page = json.loads((folder / SCORES).read_text())
        file = folder / FEATURES
        features = load_tensors(file) if file.is_file() else {}
        views = [ViewScore(**view) for view in page["views"]]
        return cls(**page | {"views": views, "features": features})

    def headline(self) -> str:
        """How many views were scored."""
        return f"{len(self.views)} views scored"
