"""What a step of training sees: objects, lights and reference views, drawn at random.

Of an evenly spaced orbit any frame may stand as the reference view: turning the object only shifts
its frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.diffusion.clips import StoredClip
from svim3d.diffusion.conditioning import camera_numbers
from svim3d.diffusion.model import ModelSpec


@dataclass(frozen=True)
class SeenClip:
    """A stored clip in one of its lights, seen from one of its frames.

    Attributes:
        clip: the object.
        light: which of its lights.
        order: of its frames, the reference view last.
    """

    clip: StoredClip
    light: int
    order: Int[Tensor, "k"]

    @classmethod
    def draw(cls, clips: Sequence[StoredClip], generator: torch.Generator) -> "SeenClip":
        """Any of them, in any light, from any view that may be a reference."""

        def below(count: int) -> int:
            return int(torch.randint(count, (1,), generator=generator))

        clip = clips[below(len(clips))]
        light, views = below(len(clip.rgb)), clip.azimuth_deg.shape[1]
        turns = clip.is_even(int(clip.form[light]))
        return cls(clip, light, clip.frames_seen_from(below(views) if turns else views - 1))

    @property
    def form(self) -> int:
        """Whether the object is as it is (0) or mirrored (1)."""
        return int(self.clip.form[self.light])

    @property
    def latents(self) -> Float[Tensor, "k c h w"]:
        """All groups, not scaled."""
        rgb, materials = self.clip.rgb[self.light][None], self.clip.materials[self.form]
        return torch.cat([rgb, materials])[:, self.order].float().transpose(0, 1).flatten(1, 2)

    @property
    def reference(self) -> Float[Tensor, "z h w"]:
        """Latent of the reference view, not scaled."""
        return self.clip.rgb[self.light, self.order[-1]].float()

    @property
    def picture(self) -> Float[Tensor, "3 t t"]:
        """The reference view as the image encoder sees it."""
        return self.clip.pictures[self.light, self.order[-1]].float() / 127.5 - 1.0

    def camera(self, spec: ModelSpec) -> Float[Tensor, "k 3"]:
        """What the model is told of the cameras."""
        elevation, azimuth = self.clip.elevation_deg[self.form], self.clip.azimuth_deg[self.form]
        return camera_numbers(elevation[self.order], azimuth[self.order], spec.cond_aug)


def draw_seen(
    clips: Sequence[StoredClip], count: int, generator: torch.Generator
) -> list[SeenClip]:
    """A batch of them, with repetition."""
    return [SeenClip.draw(clips, generator) for _ in range(count)]
