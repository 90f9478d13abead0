"""One training example: an object from all sides, in several lights, with its materials."""

from dataclasses import dataclass, fields

from jaxtyping import Float, UInt8
from torch import Tensor

GOOD = "good"  # what the metadata says of materials that can be trusted


@dataclass(frozen=True)
class TrainingExample:
    """Pictures of one object, 8 bits a channel; the last view is the reference, at azimuth 0.

    Pixels on the silhouette are blends of the straight value and the background by the mask.

    Attributes:
        rgb: display-referred (sRGB transfer of exposed radiance, clipped), on white.
        basecolor: sRGB-encoded, on white.
        orm: zero, roughness, metallic, on black.
        normal: camera frame (x right, y up, z to the camera), encoded (n + 1) / 2, on black.
        mask: coverage.
        elevation_deg: of the cameras, up from the horizon.
        azimuth_deg: of the cameras, counter-clockwise seen from above.
        metadata: fov_deg, radius, quality (good or low), name, seed, environments, transfer.
    """

    rgb: UInt8[Tensor, "E K H W 3"]
    basecolor: UInt8[Tensor, "K H W 3"]
    orm: UInt8[Tensor, "K H W 3"]
    normal: UInt8[Tensor, "K H W 3"]
    mask: UInt8[Tensor, "K H W 1"]
    elevation_deg: Float[Tensor, "K"]
    azimuth_deg: Float[Tensor, "K"]
    metadata: dict[str, str]

    @property
    def has_good_materials(self) -> bool:
        """Whether basecolor, roughness and metallic can be trusted."""
        return self.metadata.get("quality") == GOOD

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "metadata"}
