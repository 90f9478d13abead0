"""Training pixels in blocks of 2 x 2: random like single rays, yet neighbours can be compared."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.render.march import Rays

BLOCK = 2  # pixels per side
PIXELS = BLOCK * BLOCK


@dataclass(frozen=True)
class PixelBlocks:
    """Some 2 x 2 pixel blocks of V views with what the pixels should show.

    Attributes:
        cameras: V poses.
        pixels: flat indices into the V x H x W pixels; a block's four are in row order.
        targets: name -> values of those pixels.
    """

    cameras: Cameras
    pixels: Int[Tensor, "B 4"]
    targets: Mapping[str, Float[Tensor, "B 4 C"]]

    @classmethod
    def cut(cls, cameras: Cameras, images: Mapping[str, Float[Tensor, "V H W C"]]) -> "PixelBlocks":
        """All blocks of all views; an odd last row or column is left out."""
        views, height, width = len(cameras), cameras.height, cameras.width
        index = torch.arange(views * height * width, device=cameras.c2w.device)
        even = index.view(views, height, width)[:, : height // 2 * 2, : width // 2 * 2]
        rows = even.reshape(views, height // 2, BLOCK, width // 2, BLOCK).transpose(2, 3)
        pixels = rows.reshape(-1, PIXELS)
        return cls(
            cameras,
            pixels,
            {name: image.flatten(0, 2)[pixels] for name, image in images.items()},
        )

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def footprint(self) -> float:
        """Side of a pixel at the world's origin, world units."""
        return float(self.cameras.positions.norm(dim=-1).mean()) / self.cameras.focal_px

    def take(self, chosen: Int[Tensor, "K"] | Bool[Tensor, "B"]) -> "PixelBlocks":
        """The chosen blocks."""
        return PixelBlocks(
            self.cameras,
            self.pixels[chosen],
            {name: values[chosen] for name, values in self.targets.items()},
        )

    def showing(self, targets: Mapping[str, Float[Tensor, "B 4 _"]]) -> "PixelBlocks":
        """The same pixels with other values that they should show."""
        return PixelBlocks(self.cameras, self.pixels, targets)

    def rays(self) -> Rays:
        """Rays through the pixels' centres, block after block."""
        return pixel_rays(self.cameras, self.pixels.reshape(-1))


def pixel_rays(cameras: Cameras, pixels: Int[Tensor, "P"]) -> Rays:
    """Rays through the centres of pixels, given by flat indices into those of all views."""
    per_view = cameras.height * cameras.width
    view = pixels // per_view
    local = cameras.pixel_directions(pixels % per_view)
    rotation = cameras.c2w[:, :3, :3].index_select(0, view)
    directions = (rotation @ local[..., None])[..., 0]
    return Rays(cameras.positions.index_select(0, view), directions)
