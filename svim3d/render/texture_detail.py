"""Whether a finer texture shows more: fitted to half of the views, asked of the other half.

One look at a surface holds a texel for each of its pixels. Many looks, each a fraction of a pixel
beside the others, hold more where the object has edges that are sharper than pixels, and nothing
where it has none; what is fitted then is noise, and views that it was not fitted to show it.
"""

import math
from collections.abc import Iterable

from jaxtyping import Float
from torch import Tensor

from svim3d.render.material_evidence import Channels
from svim3d.render.texture_fit import fit_texels
from svim3d.render.view_pixels import ViewPixels

EXACT = 1e-12  # a mean square error below this is none


def unseen_errors(
    pixels: ViewPixels,
    start: Float[Tensor, "T C"],
    groups: Iterable[Channels],
    *,
    prior: float,
    iterations: int,
) -> dict[str, float]:
    """Mean square errors, by group, in every other view of a texture fitted to the views between.

    Only pixels count whose texels the fitted views have seen; without any there is no figure.

    Args:
        pixels: what the views show, over the texture.
        start: its texels as the field has them, before any fit of texels. The field has learnt from
            all views, which makes no difference between sizes of textures.
        groups: which channels are judged together.
        prior: see `fit_texels`.
        iterations: of the fit.
    """
    is_fitted = pixels.view % 2 == 0
    known, asked = pixels.take(is_fitted), pixels.take(~is_fitted)
    fitted = fit_texels(
        known.operator, known.target, known.weight, start, prior=prior, iterations=iterations
    )
    shown = asked.operator(fitted)
    weight = asked.weight.double() * asked.known_to(known)[:, None]
    total = float(weight.sum())
    if total == 0.0:
        return {}
    errors = {}
    for group in groups:
        squared = (
            (group.encoded(shown) - group.encoded(asked.target)).square().mean(1, keepdim=True)
        )
        errors[group.name] = float((weight * squared).sum() / total)
    return errors


def gained_db(before: float, after: float) -> float:
    """By how much a mean square error has fallen; 0 where there was none."""
    return 10.0 * math.log10(before / max(after, EXACT)) if before > 0.0 else 0.0
