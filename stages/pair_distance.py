"""A learned distance of pairs of pictures, called by what a user's weights are of."""

from pathlib import Path

from svim3d.io.weights import load_state
from svim3d.losses.lpips import Lpips
from svim3d.render.view_figures import Perceptual

LPIPS, SHIFT_TOLERANT = "lpips", "st_lpips"


def read_distance(weights: Path | None) -> Perceptual | None:
    """LPIPS, of the kind that the file holds; None without a file.

    Raises:
        ValueError: the file is missing or holds something else.
    """
    if weights is None:
        return None
    network = Lpips.of(load_state(weights))
    return Perceptual(SHIFT_TOLERANT if network.is_shift_tolerant else LPIPS, network)
