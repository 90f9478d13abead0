"""Geometry buffers: what an image-space renderer knows of the pixels of some views."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.cameras import Cameras


@dataclass(frozen=True)
class GBuffer:
    """Materials, normals and, where it is known, depth of V views. Nothing here is premultiplied.

    Attributes:
        cameras: V poses; all views share field of view and size.
        mask: coverage in [0, 1].
        basecolor: linear.
        roughness: perceptual.
        metallic: in [0, 1].
        normal_world: unit shading normals; zero where there is no surface.
        depth: distance along the camera's -z axis, world units; None where nobody knows it.
    """

    cameras: Cameras
    mask: Float[Tensor, "V H W 1"]
    basecolor: Float[Tensor, "V H W 3"]
    roughness: Float[Tensor, "V H W 1"]
    metallic: Float[Tensor, "V H W 1"]
    normal_world: Float[Tensor, "V H W 3"]
    depth: Float[Tensor, "V H W 1"] | None = None

    def __len__(self) -> int:
        return len(self.cameras)

    @classmethod
    def of(cls, cameras: Cameras, images: Mapping[str, Tensor]) -> Self:
        """From named images, such as those of an orbit; further names are passed over."""
        names = [f.name for f in fields(cls) if f.name != "cameras"]
        return cls(cameras=cameras, **{name: images[name] for name in names if name in images})

    def images(self) -> dict[str, Tensor]:
        """The images by name, depth only where it is known."""
        named = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "cameras"}
        return {name: image for name, image in named.items() if image is not None}

    def take(self, views: list[int]) -> Self:
        """Some of the views, in the order given."""
        chosen = {name: image[views] for name, image in self.images().items()}
        return replace(self, cameras=self.cameras[views], **chosen)

    def view_directions(self, view: int) -> Float[Tensor, "H W 3"]:
        """Unit directions from the surface to the viewer, world frame."""
        _, rays = self.cameras.rays(view)
        return -rays.view(self.cameras.height, self.cameras.width, 3)

    def positions(self, view: int) -> Float[Tensor, "H W 3"]:
        """World-space points that the pixels show.

        Raises:
            ValueError: the depth of these views is not known.
        """
        if self.depth is None:
            raise ValueError("wanted views with depth, these have none; add the channel depth.Z")
        pixels = torch.arange(self.cameras.height * self.cameras.width, device=self.mask.device)
        local = self.cameras.pixel_directions(pixels)
        # Depth runs along -z, so a ray is as long as its z component is short.
        local = local / -local[:, 2:] * self.depth[view].reshape(-1, 1)
        points = local @ self.cameras.c2w[view, :3, :3].T + self.cameras.positions[view]
        return points.view(self.cameras.height, self.cameras.width, 3)
