"""Figures of one view against the truth, and views under another light.

All figures run over the true mask (> 0.5). Pictures are clipped to [0, 1] and sRGB-encoded, as a
photo of theirs would be; where a view shows nothing, it is black there.
"""

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.color import srgb_from_linear
from svim3d.metrics.alignment import align_scale
from svim3d.metrics.directions import mean_angle_deg
from svim3d.metrics.pictures import psnr, rmse, structural_similarity
from svim3d.render.gbuffer import GBuffer
from svim3d.render.image_shading import ViewPoints
from svim3d.shading.prefilter import EnvironmentPyramid

COVERED = 0.5
BUFFERS = ("basecolor", "roughness", "metallic", "normal_world")

Picture = dict[str, Float[Tensor, "_ _ _"]]
Figures = dict[str, float]


@dataclass(frozen=True)
class Perceptual:
    """A learned distance of pictures, and what it is called.

    Attributes:
        name: `lpips` or `st_lpips`.
        distance: mean over pairs of encoded pictures [N, H, W, 3].
    """

    name: str
    distance: Callable[[Tensor, Tensor], Tensor]


def view_figures(
    shown: Picture,
    truth: Picture,
    *,
    gain: float,
    true_gain: float,
    perceptual: Perceptual | None = None,
) -> Figures:
    """What can be told of a view: of each image that both have.

    Args:
        shown: `mask` and any of radiance (premultiplied), basecolor, roughness, metallic and
            normal_world (straight), each [H, W, C].
        truth: the same.
        gain: exposure of the shown radiance.
        true_gain: exposure of the true one.
        perceptual: adds `rgb_lpips` and `basecolor_lpips`, named after it.

    Returns:
        `rgb_db`, `rgb_ssim`, `basecolor_db`, `basecolor_ssim`, `basecolor_scaled_db` (after a least
        squares scale per channel in linear light), `roughness_rmse`, `metallic_rmse`,
        `normal_deg`, `mask_iou`.
    """
    mask = truth["mask"] > COVERED
    seen = shown["mask"] > COVERED
    figures = {"mask_iou": float((mask & seen).sum() / (mask | seen).sum().clamp_min(1))}
    both = shown.keys() & truth.keys()
    cover = shown["mask"]
    if "radiance" in both:
        pair = _encoded(shown["radiance"] * gain), _encoded(truth["radiance"] * true_gain)
        figures |= _picture_figures("rgb", *pair, mask, perceptual)
    if "basecolor" in both:
        laid, true = shown["basecolor"] * cover, truth["basecolor"] * (truth["mask"] > 0)
        pair = _encoded(laid), _encoded(true)
        figures |= _picture_figures("basecolor", *pair, mask, perceptual)
        scaled = _encoded(align_scale(laid, true, mask))
        figures["basecolor_scaled_db"] = psnr(scaled, pair[1], mask)
    for name in both & {"roughness", "metallic"}:
        figures[f"{name}_rmse"] = rmse(shown[name] * cover, truth[name], mask)
    if "normal_world" in both:
        figures["normal_deg"] = mean_angle_deg(shown["normal_world"], truth["normal_world"], mask)
    return figures


def relit(
    cameras: Cameras, images: dict[str, Tensor], view: int, light: EnvironmentPyramid
) -> Float[Tensor, "H W 3"]:
    """Radiance, premultiplied, of a view's materials and normals under a light.

    Where there is depth, the object shadows and lights itself; there is no multiple scattering
    between microfacets, as in path-traced truth.
    """
    gbuffer = GBuffer.of(cameras, images)
    points = (ViewPoints.of if gbuffer.depth is None else ViewPoints.occluded)(gbuffer, view)
    radiance = points.lit(light, multiple_scattering=False).radiance
    return points.image(radiance) * gbuffer.mask[view]


def _encoded(linear: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    return srgb_from_linear(linear.clamp(0.0, 1.0))


def _picture_figures(
    name: str,
    image: Float[Tensor, "H W 3"],
    truth: Float[Tensor, "H W 3"],
    mask: Bool[Tensor, "H W 1"],
    perceptual: Perceptual | None,
) -> Figures:
    """PSNR and SSIM inside the mask, the latter and LPIPS of pictures that are black outside."""
    laid, true = ((x * mask)[None] for x in (image, truth))
    figures = {
        f"{name}_db": psnr(image, truth, mask),
        f"{name}_ssim": float(structural_similarity(laid, true)[0][mask].mean()),
    }
    if perceptual is not None:
        figures[f"{name}_{perceptual.name}"] = float(perceptual.distance(laid, true))
    return figures
