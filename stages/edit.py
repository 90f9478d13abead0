"""Edit an asset: a GLB with other materials, from edits as text or from the record of a relight.

Not a stage of a pipeline: one small file in, one out.
"""

from collections.abc import Sequence
from pathlib import Path

from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from stages.errors import InputError
from svim3d.io.edit_record import EditRecord, read_record, read_region
from svim3d.io.glb import read_mesh
from svim3d.io.gltf_edit import MaskOf, edit_glb
from svim3d.mesh.source_mesh import normalised
from svim3d.render.pictures import render_gbuffer
from svim3d.render.regions import region_of_texels, resized_region
from svim3d.shading.material_edits import Edit

MIN_DEPTH_ROWS = 1024  # of the depth that tells which texels a view sees: about one per texel


def edit_asset(
    file: Path, texts: Sequence[str], *, mask: Path | None = None, record: Path | None = None
) -> tuple[bytes, list[str]]:
    """The asset with other materials, and messages.

    Args:
        file: a .glb; a record replayed on it was made on views of this very object.
        texts: edits, applied after those of the record.
        mask: picture in texture space; white is edited.
        record: `edits.json` of relit views. Its region is carried to the texels that its view sees.

    Raises:
        InputError: nothing to do, or something that cannot be done.
    """
    try:
        edits = [Edit.parse(text) for text in texts]
        mask_of: MaskOf | None = None
        if record is not None:
            kept = read_record(record)
            edits = [*kept.edits, *edits]
            if kept.region is not None and mask is not None:
                raise InputError("the record has a region of its own: leave out --mask")
            mask_of = None if kept.region is None else _replayed(file, kept)
        if mask is not None:
            mask_of = _texture_region(read_region(mask))
        if not edits:
            raise InputError("nothing to edit: give --edit or --replay")
        if not file.is_file():
            raise InputError(f"there is no asset {file}; check the path")
        return edit_glb(file.read_bytes(), edits, mask_of)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{file.name}: {error}") from error


def _texture_region(region: Float[Tensor, "H W 1"]) -> MaskOf:
    """One region for the textures of all materials, whatever their proportions."""

    def mask_of(_: int, height: int, width: int) -> Tensor:
        moved = region.permute(2, 0, 1)[None]
        found = interpolate(moved, size=(height, width), mode="bilinear", antialias=True)
        return found[0].permute(1, 2, 0)

    return mask_of


def _replayed(file: Path, record: EditRecord) -> MaskOf:
    """The region of a view, on the texels that it sees."""
    mesh = normalised(read_mesh(file), file.name)
    if record.camera is None or record.region is None:
        raise ValueError("the record has no region")
    finer = -(-MIN_DEPTH_ROWS // record.camera.height)
    size = (record.camera.height * finer, record.camera.width * finer)
    seen = render_gbuffer(mesh, record.camera.resized(*size))
    region = resized_region(record.region, *size)

    def mask_of(material: int, height: int, width: int) -> Tensor | None:
        found = region_of_texels(mesh, material, (height, width), region, seen)
        return found if bool((found > 0.0).any()) else None

    return mask_of
