"""The photo between its preparation and the generator: a frozen value like those of artifacts."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.io.image import read_png, write_png


@dataclass(frozen=True)
class Placement:
    """Where the square lies on the photo.

    Pixel x of the square, from its left, shows the photo's x = (x - size / 2) / scale + middle of
    the box; the same holds for y, from the top.

    Attributes:
        height: rows of the photo, upright.
        width: columns of the photo.
        top: first row of the object's box, photo pixels; a fraction where the photo was reduced.
        left: first column.
        bottom: row after the last.
        right: column after the last.
        scale: pixels of the square per pixel of the photo.
    """

    height: int
    width: int
    top: float
    left: float
    bottom: float
    right: float
    scale: float


@dataclass(frozen=True)
class PreparedPhoto:
    """One object, centred in a square.

    Attributes:
        rgb: sRGB-encoded, straight (not premultiplied), 8 bit deep; zero where the mask is.
        mask: coverage in [0, 1], 8 bit deep.
        placement: where it came from.
        cut_out: what told the object from its background: `alpha`, `network` or `plain`.
    """

    rgb: Float[Tensor, "S S 3"]
    mask: Float[Tensor, "S S 1"]
    placement: Placement
    cut_out: str

    def save(self, folder: Path) -> None:
        """Write one picture with opacity and a readable placement."""
        write_png(folder / "prepared.png", torch.cat([self.rgb, self.mask], -1))
        about = {"cut_out": self.cut_out, "placement": asdict(self.placement)}
        (folder / "prepared.json").write_text(json.dumps(about, indent=1))

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read both files."""
        picture = read_png(folder / "prepared.png")
        about = json.loads((folder / "prepared.json").read_text())
        return cls(
            rgb=picture[..., :3].contiguous(),
            mask=picture[..., 3:].contiguous(),
            placement=Placement(**about["placement"]),
            cut_out=about["cut_out"],
        )

    def headline(self) -> str:
        """Size of the square, how full it is, and what cut the object out."""
        share = 100 * float(self.mask.mean())
        return f"{len(self.rgb)} px square, {share:.0f} % covered, cut out by {self.cut_out}"
