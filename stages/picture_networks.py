"""Networks that sets of pictures are compared by, from files that users have them in."""

from pathlib import Path

import torch

from stages.errors import InputError
from stages.set_figures import CLIP
from svim3d.io.picture_networks import Encoder, read_clip, read_efficientnet, read_inception


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
