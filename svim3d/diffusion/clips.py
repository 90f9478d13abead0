"""Clips as the trainer keeps them: latents and cameras of an object from all sides, in some lights.

An object may be kept twice, as it is and mirrored; and of an evenly spaced orbit any frame may
stand as the reference view, since turning the object only shifts its frames.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

EVENLY_SPACED_DEG = 0.01  # largest departure of an azimuth from an even orbit


@dataclass(frozen=True)
class StoredClip:
    """One object's latents, not scaled, in half precision.

    Attributes:
        rgb: of each light.
        materials: basecolor, ORM and normal; of the object, and mirrored if any light sees it so.
        form: for each light, which of `materials` (0 or 1) goes with it.
        pictures: each frame as the image encoder sees it, display-referred, 8 bit.
        elevation_deg: of each frame, for each form.
        azimuth_deg: of each frame, for each form; the last is the reference view's, 0.
        has_good_materials: whether materials can be learnt from.
        tokens: each frame's embedding, where the image encoder does not learn.
    """

    rgb: Float[Tensor, "l k z h w"]
    materials: Float[Tensor, "m 3 k z h w"]
    form: Int[Tensor, "l"]
    pictures: UInt8[Tensor, "l k 3 t t"]
    elevation_deg: Float[Tensor, "m k"]
    azimuth_deg: Float[Tensor, "m k"]
    has_good_materials: bool
    tokens: Float[Tensor, "l k d"] | None = None

    def frames_seen_from(self, reference: int) -> Int[Tensor, "k"]:
        """Order of the frames in which `reference` is the last and azimuths ascend."""
        count = self.azimuth_deg.shape[1]
        return (torch.arange(count) + reference + 1) % count

    def is_even(self, form: int) -> bool:
        """Whether the orbit looks the same from each of its frames."""
        azimuth, elevation = self.azimuth_deg[form], self.elevation_deg[form]
        count = len(azimuth)
        even = (torch.arange(1, count + 1) * (360.0 / count)) % 360.0
        is_level = bool((elevation - elevation[0]).abs().max() < EVENLY_SPACED_DEG)
        return is_level and bool((azimuth - even).abs().max() < EVENLY_SPACED_DEG)


def mirrored_pictures(pictures: UInt8[Tensor, "*b k H W c"]) -> UInt8[Tensor, "*b k H W c"]:
    """Frames of the mirrored object, in the order in which its azimuths ascend."""
    return in_mirrored_order(pictures.flip(-2), axis=-4)


def mirrored_normals(
    normal: UInt8[Tensor, "k H W 3"], mask: UInt8[Tensor, "k H W 1"]
) -> UInt8[Tensor, "k H W 3"]:
    """The same for encoded normals over black, whose x changes its sign.

    A pixel m (x + 1) / 2 becomes m (1 - x) / 2, which is the coverage minus the pixel.
    """
    turned = torch.cat([mask - torch.minimum(normal[..., :1], mask), normal[..., 1:]], -1)
    return mirrored_pictures(turned)


def mirrored_azimuths(azimuth_deg: Float[Tensor, "k"]) -> Float[Tensor, "k"]:
    """Azimuths of the mirrored orbit, ascending, the reference view's last."""
    return (360.0 - in_mirrored_order(azimuth_deg, axis=0)) % 360.0


def in_mirrored_order(frames: Tensor, *, axis: int) -> Tensor:
    """All frames but the last the other way round."""
    last = frames.shape[axis] - 1
    order = torch.tensor([*range(last - 1, -1, -1), last], device=frames.device)
    return frames.index_select(axis, order)
