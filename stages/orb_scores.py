"""Figures by Stanford-ORB's rules, of what an asset shows or of what is missing.

Names: `orb.official.ssim` and its like of pictures, by row; `orb.albedo.official.ssim` of albedo;
`orb.geometry.normal`. Depth and shape are of a whole capture and told in its units of length.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from stages.pair_distance import LPIPS
from stages.scores_artifact import NOVEL, RELIT, Figures
from stages.truth import Truth
from svim3d.metrics.stanford_orb import (
    Distance,
    compare_albedo,
    compare_pictures,
    depth_error,
    normal_error,
    shape_error,
)
from svim3d.render.view_figures import COVERED, Perceptual

ORB, ALBEDO, GEOMETRY = "orb", "albedo", "geometry"

Picture = Mapping[str, Tensor]
Mesh = tuple[Tensor, Tensor]


def orb_figures(
    part: str,
    shown: Picture | None,
    truth: Picture,
    *,
    gain: float = 1.0,
    learned: Perceptual | None = None,
) -> Figures:
    """Figures of a test view; none of other parts.

    Args:
        part: `novel` views are not scaled, `relit` ones are; albedo and normals, where they are
            known, are scored once, of novel views.
        shown: radiance (premultiplied), and for a novel view basecolor and normal_world (straight)
            and mask; None if there is no asset: white is scored then.
        truth: the same, of which radiance and mask have to be there.
        gain: from the shown radiance to the true one's exposure.
        learned: LPIPS is told where this is it.
    """
    if part not in (NOVEL, RELIT):
        return {}
    mask = truth["mask"] > COVERED
    lpips: Distance | None = None
    if learned is not None and learned.name == LPIPS:
        lpips = learned.distance
    image = None if shown is None else shown["radiance"] * gain
    scaled = part == RELIT
    score = compare_pictures(image, truth["radiance"], mask, scaled=scaled, lpips=lpips)
    figures = _named(ORB, score.rows)
    if part == RELIT or (shown is not None and "basecolor" not in shown):
        return figures
    if "basecolor" in truth:
        albedo = None if shown is None else shown["basecolor"] * shown["mask"]
        score = compare_albedo(albedo, truth["basecolor"], mask, lpips=lpips)
        figures |= _named(f"{ORB}.{ALBEDO}", score.rows)
    if "normal_world" in truth:
        normals = None if shown is None else shown["normal_world"]
        error = normal_error(normals, truth["normal_world"], mask)
        figures[f"{ORB}.{GEOMETRY}.normal"] = error
    return figures


def _named(prefix: str, rows: Mapping[str, Mapping[str, float]]) -> Figures:
    return {f"{prefix}.{r}.{name}": v for r, row in rows.items() for name, v in row.items()}


def capture_figures(
    depths: Sequence[Tensor] | None, mesh: Mesh | None, truth: Truth, generator: torch.Generator
) -> Figures:
    """`depth` and `shape` of a capture, where the truth knows them.

    Args:
        depths: of the test views; None if there is no asset, which has no such figure.
        mesh: vertices and faces in the truth's frame; None counts as a point in the origin of the
            capture's world.
        truth: of the capture.
        generator: of samples on the mesh.
    """
    figures: Figures = {}
    squared = truth.unit**2  # both are mean squares
    known = {} if truth.novel is None else truth.novel[1]
    if depths is not None and "depth" in known:
        masks = [mask > COVERED for mask in known["mask"]]
        figures["depth"] = squared * depth_error(depths, list(known["depth"]), masks)
    if truth.surface is not None:
        scan = truth.surface[0]
        if mesh is None:
            scan = scan - scan.new_tensor(truth.origin)
        figures["shape"] = squared * shape_error(mesh, scan, generator)
    return figures
