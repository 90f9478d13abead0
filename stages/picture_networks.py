"""Figures that need a network: of pairs of pictures, and of whole sets of them.

A name belongs to its network: `lpips` is the published one and `st_lpips` the shift-tolerant,
`fid` is Inception's alone, and the same distance of another network's features is called after it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from stages.errors import InputError
from stages.set_figures import CLIP
from stages.settings.picture_networks import PictureNetworkSettings
from svim3d.io.picture_networks import Encoder, read_clip, read_efficientnet, read_inception
from svim3d.io.weights import load_state
from svim3d.losses.lpips import Lpips
from svim3d.metrics.features import clip_similarity, cmmd, frechet_distance

# Whether more is better, by figure.
IS_BETTER_HIGH = {
    "lpips": False,
    "st_lpips": False,
    "frechet_efficientnet": False,
    "fid": False,
    "cmmd": False,
    "clip_similarity": True,
}


@dataclass(frozen=True)
class PictureNetworks:
    """The networks that there are weights for.

    Attributes:
        distances: of pairs of pictures, `lpips` and `st_lpips`.
        frechet: encoders by the figure that they give, `frechet_efficientnet` and `fid`.
        clip: encoder of `cmmd` and `clip_similarity`, or None.
        device: that they live on.
    """

    distances: Mapping[str, Lpips]
    frechet: Mapping[str, Encoder]
    clip: Encoder | None
    device: torch.device

    @classmethod
    def load(cls, settings: PictureNetworkSettings, device: torch.device) -> Self:
        """Read whatever the settings name.

        Raises:
            InputError: a named file is missing or holds something else.
        """
        distances = {
            name: _read_lpips(name, file, device)
            for name, file in (
                ("lpips", settings.lpips_weights),
                ("st_lpips", settings.st_lpips_weights),
            )
            if file is not None
        }
        frechet = read_encoders(
            settings.efficientnet_weights, settings.inception_weights, settings.clip_folder, device
        )
        clip = frechet.pop(CLIP, None)
        return cls(distances, frechet, clip, device)

    def compare_pairs(
        self, predictions: Float[Tensor, "N H W 3"], truths: Float[Tensor, "N H W 3"]
    ) -> dict[str, float]:
        """Mean LPIPS of pairs of display-encoded pictures in [0, 1], by each network there is."""
        with torch.no_grad():
            pair = (predictions.to(self.device).float(), truths.to(self.device).float())
            return {name: float(network(*pair)) for name, network in self.distances.items()}

    def compare_sets(
        self, predictions: Float[Tensor, "N H W 3"], truths: Float[Tensor, "M h w 3"]
    ) -> dict[str, float]:
        """Distances of sets of display-encoded pictures in [0, 1], each on one background.

        A single picture has no spread: for sets of fewer than two there is no Fréchet distance.
        `clip_similarity` is of pairs, and left out where the sets differ in size.
        """
        figures: dict[str, float] = {}
        is_spread = min(len(predictions), len(truths)) > 1
        sets = predictions.to(self.device), truths.to(self.device)
        for name, encode in self.frechet.items() if is_spread else ():
            figures[name] = frechet_distance(*(encode(pictures) for pictures in sets))
        if self.clip is not None:
            seen, wanted = (self.clip(pictures) for pictures in sets)
            figures["cmmd"] = cmmd(seen, wanted)
            if len(seen) == len(wanted):
                figures["clip_similarity"] = clip_similarity(seen, wanted)
        return figures


def read_encoders(
    efficientnet: Path | None, inception: Path | None, clip: Path | None, device: torch.device
) -> dict[str, Encoder]:
    """Networks whose features sets are compared by: by the Fréchet figure they give, or `clip`.

    Args:
        efficientnet: state of EfficientNet-Lite0.
        inception: state of pytorch-fid's Inception.
        clip: folder of a CLIPModel.
        device: that they shall live on.

    Raises:
        InputError: a named file is missing or holds something else.
    """
    named = (
        ("frechet_efficientnet", efficientnet, read_efficientnet),
        ("fid", inception, read_inception),
        (CLIP, clip, read_clip),
    )
    try:
        return {name: read(path, device) for name, path, read in named if path is not None}
    except ValueError as error:
        raise InputError(str(error)) from error


def _read_lpips(name: str, file: Path, device: torch.device) -> Lpips:
    """LPIPS, of the kind that its name says.

    Raises:
        InputError: no such file, or the other kind's weights.
    """
    try:
        network = Lpips.of(load_state(file))
    except ValueError as error:
        raise InputError(f"{name}_weights: {error}") from error
    if network.is_shift_tolerant != (name == "st_lpips"):
        other = "st_lpips_weights" if name == "lpips" else "lpips_weights"
        raise InputError(
            f"{name}_weights wanted the {'plain' if name == 'lpips' else 'shift-tolerant'} network,"
            f" {file.name} holds the other one; give it as {other}"
        )
    return network.to(device)
