"""The record of edits beside relit views, from which they can be replayed on the asset."""

import json
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.io.image import encode_png, read_png
from svim3d.shading.material_edits import Edit

FORMAT = 1  # of the record; a reader refuses what it does not know
RECORD, MASK = "edits.json", "mask.png"


@dataclass(frozen=True)
class EditRecord:
    """Edits, and on which part of which view they were made.

    Attributes:
        edits: in order.
        region: share of the edits per pixel, as a picture of a view; None edits everything.
        camera: the view on which the region was drawn; None without a region.
    """

    edits: tuple[Edit, ...]
    region: Float[Tensor, "H W 1"] | None = None
    camera: Cameras | None = None

    def files(self) -> dict[str, bytes]:
        """The record as files: name -> content."""
        page: dict[str, object] = {"format": FORMAT, "edits": [str(edit) for edit in self.edits]}
        files = {}
        if self.region is not None and self.camera is not None:
            page |= {
                "mask": MASK,
                "camera": {
                    "c2w": self.camera.c2w[0].tolist(),
                    "fov_y_deg": self.camera.fov_y_deg,
                    "height": self.camera.height,
                    "width": self.camera.width,
                },
            }
            files[MASK] = encode_png(self.region)
        return {RECORD: json.dumps(page, indent=1).encode(), **files}


def read_region(file: Path) -> Float[Tensor, "H W 1"]:
    """A region from a picture: white is in; where there is opacity, transparent is out.

    Raises:
        ValueError: it is no picture, or nothing in it is white.
    """
    picture = read_png(file)
    colours = picture[..., :1] if picture.shape[-1] < 3 else picture[..., :3]
    region = colours.mean(-1, keepdim=True)
    if picture.shape[-1] in (2, 4):
        region = region * picture[..., -1:]
    if not bool((region > 0.0).any()):
        raise ValueError(f"the region in {file.name} is empty: white marks what is edited")
    return region


def read_record(file: Path) -> EditRecord:
    """Read a record with its mask.

    Raises:
        ValueError: it is missing, no record, or of another format.
    """
    if not file.is_file():
        raise ValueError(f"there is no record of edits {file}")
    try:
        page = json.loads(file.read_text())
        if page["format"] != FORMAT:
            raise ValueError(f"{file} has format {page['format']}, wanted {FORMAT}")
        edits = tuple(Edit.parse(text) for text in page["edits"])
        if "mask" not in page:
            return EditRecord(edits)
        camera = page["camera"]
        c2w = torch.tensor(camera["c2w"], dtype=torch.float32).view(1, 4, 4)
        size = int(camera["height"]), int(camera["width"])
        cameras = Cameras(c2w, float(camera["fov_y_deg"]), *size)
    except (KeyError, TypeError, json.JSONDecodeError, UnicodeDecodeError, RuntimeError) as error:
        raise ValueError(f"{file} is no record of edits: {error!r}") from error
    return EditRecord(edits, read_region(file.parent / Path(page["mask"]).name), cameras)
