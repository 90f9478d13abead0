"""From baked texels to the maps of an asset: all as textures, or each in the form that it needs."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.color import srgb_from_linear
from svim3d.mesh.frames import world_from_tangent
from svim3d.mesh.painted_mesh import PaintedMesh
from svim3d.mesh.texels import Texels, average_down, fill_empty, to_image
from svim3d.numerics import normalize
from svim3d.render.material_evidence import (
    BASECOLOR,
    GROUPS,
    METALLIC,
    ROUGHNESS,
    Channels,
    Verdict,
    cost,
    judge,
)
from svim3d.render.palettes import growing_palettes, palette_values
from svim3d.render.texture_detail import gained_db, unseen_errors
from svim3d.render.texture_fit import fit_texels
from svim3d.render.texture_size import size_for_pixels, sufficient_texels
from svim3d.render.view_pixels import FLOOR_RMS, ViewPixels

NORMAL, OCCLUSION = "normal", "occlusion"
# RMS angle below which normals are not told apart: decimation may turn them by 1 degree on average,
# which is 1.13 to 1.3 degrees RMS.
NORMAL_FLOOR_RAD = math.radians(1.25)
# What a texture of twice the side, which takes three to four times the bytes, has to gain in views
# that it was not fitted to. Fitted to all of them it gains two to three times as much.
FINER_PAYS_DB = 0.3
NO_OCCLUSION = FLOOR_RMS  # RMS share of hidden sky that nobody sees


@dataclass(frozen=True)
class BakedTexels:
    """What was baked, one row per texel that shows the surface.

    Attributes:
        surface: basecolor (linear), roughness and metallic.
        unfitted: the same before it was sharpened against the views.
        occlusion: share of the sky that is seen.
        local: shading normals in tangent space.
        mesh: whose texels they are, with tangents.
        texels: where they lie.
    """

    surface: Float[Tensor, "P 5"]
    unfitted: Float[Tensor, "P 5"]
    occlusion: Float[Tensor, "P 1"]
    local: Float[Tensor, "P 3"]
    mesh: PaintedMesh
    texels: Texels

    def world_normals(self) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
        """Shading normals that a viewer sees without the normal map, and those with it."""
        normal, tangent, bitangent = self.mesh.frame(self.texels)
        mapped = world_from_tangent(normalize(self.local), normal, tangent, bitangent)
        return normalize(normal), mapped


@dataclass(frozen=True)
class MaterialMaps:
    """An asset's materials.

    Attributes:
        basecolor: linear; a texture, or one colour.
        orm: occlusion, roughness, metallic; a texture, or one value.
        orm_factor: multiplies `orm`, whose constant channels are 1 then; None in textures as baked.
        normal_tangent: texture of unit normals, green up, or None.
        notes: by map, what was chosen and why.
    """

    basecolor: Float[Tensor, "*basecolor 3"]
    orm: Float[Tensor, "*orm 3"]
    orm_factor: Float[Tensor, "3"] | None
    normal_tangent: Float[Tensor, "T T 3"] | None
    notes: dict[str, str]


@dataclass(frozen=True)
class Wanted:
    """How maps are to be made.

    Attributes:
        nested: choose each map's form, else all are textures.
        sized: choose each texture's size, else all have that of the texels.
        prior: of the textures' fit that the views' halves are compared by, see `fit_texels`.
        iterations: of that fit.
        sharpened: steps of the fit of a texture whose size has changed; 0: none.
        lost_db: how much farther from held-out pixels than a texture a form may be.
    """

    nested: bool
    sized: bool
    prior: float
    iterations: int
    sharpened: int
    lost_db: float = math.inf


def material_maps(
    baked: BakedTexels,
    pixels_at: Callable[[int], ViewPixels],
    normals: Float[Tensor, "V H W 3"],
    wanted: Wanted,
) -> MaterialMaps:
    """All maps of an asset.

    Args:
        baked: the finished texels.
        pixels_at: what the views say of basecolor, roughness and metallic, in terms of the texels
            of a texture of a given size.
        normals: what they say of normals, world frame.
        wanted: which choices are made.
    """
    if not (wanted.nested or wanted.sized):
        return _as_baked(baked)
    return _Maker(baked, pixels_at, normals, wanted).maps()


def _as_baked(baked: BakedTexels) -> MaterialMaps:
    """Textures of the texels' own size."""
    surface, occlusion = baked.surface, baked.occlusion
    together = torch.cat([surface, baked.local, occlusion], 1)
    image = to_image(together, baked.texels)
    return MaterialMaps(
        basecolor=image[..., :3].clamp(0.0, 1.0),
        orm=image[..., [8, 3, 4]].clamp(0.0, 1.0),
        orm_factor=None,
        normal_tangent=normalize(image[..., 5:8]),
        notes={},
    )


class _Maker:
    """Chooses form and size of each map of one asset."""

    def __init__(
        self,
        baked: BakedTexels,
        pixels_at: Callable[[int], ViewPixels],
        normals: Float[Tensor, "V H W 3"],
        wanted: Wanted,
    ) -> None:
        size = baked.texels.size
        pixels = pixels_at(size)
        self._baked, self._pixels, self._normals, self._wanted = baked, pixels, normals, wanted
        self._pixels_at = pixels_at
        distinct, self._seen = pixels.distinct()
        self._enough = size_for_pixels(distinct, self._seen, size)
        stored = {
            BASECOLOR.name: srgb_from_linear(baked.surface[:, :3].clamp(0.0, 1.0)),
            ROUGHNESS.name: baked.surface[:, 3:4],
            METALLIC.name: baked.surface[:, 4:5],
            NORMAL: baked.local * 0.5 + 0.5,
            OCCLUSION: baked.occlusion,
        }
        found = {
            name: sufficient_texels(values, baked.texels, most=self._enough)
            for name, values in stored.items()
        }
        self._gains = self._gains_of_finer()
        self._sizes = {name: size for name in stored}
        if wanted.sized:
            self._sizes = {name: texels.texels.size for name, texels in found.items()}
            for name, gain in self._gains.items():
                if gain >= FINER_PAYS_DB:
                    finer = sufficient_texels(stored[name], baked.texels, most=2 * self._enough)
                    self._sizes[name] = finer.texels.size
        # Only what is seen counts as known: the rest is as baked in any form.
        self._counts = {
            name: max(1, round(self._seen * (texels.texels.size / size) ** 2))
            for name, texels in found.items()
        }

    def _gains_of_finer(self) -> dict[str, float]:
        """By how much maps of twice the size show unseen views better, dB, where it may matter."""
        wanted, pixels = self._wanted, self._pixels
        looks = float((pixels.weight > 0.0).sum())
        most = size_for_pixels(looks, self._seen, pixels.texture_size)
        if not (wanted.sized and wanted.sharpened) or most <= self._enough:
            return {}
        errors = [
            unseen_errors(
                self._pixels_at(size),
                self._averaged(self._baked.unfitted, size).reshape(size * size, -1),
                GROUPS,
                prior=wanted.prior,
                iterations=wanted.sharpened,
            )
            for size in (self._enough, 2 * self._enough)
        ]
        coarse, fine = errors
        return {name: gained_db(coarse[name], fine[name]) for name in coarse.keys() & fine.keys()}

    def maps(self) -> MaterialMaps:
        """Every map in its form and size."""
        verdicts: dict[str, Verdict] = {}
        notes: dict[str, str] = {}
        if self._wanted.nested:
            factor = self._baked.texels.size // self._enough
            verdicts = judge(
                self._pixels.coarsened(factor),
                texel_count=self._counts,
                prior=self._wanted.prior,
                iterations=self._wanted.iterations,
                most_lost_db=self._wanted.lost_db,
            )
            notes = {name: str(verdict) for name, verdict in verdicts.items()}
            for group in GROUPS:
                notes.setdefault(group.name, "texture, for the views cannot check each other")
        basecolor = self._basecolor(verdicts.get(BASECOLOR.name))
        orm, factor_orm = self._orm(verdicts, notes)
        normal = self._normal_map(notes)
        textured = {BASECOLOR.name: basecolor, "orm": orm, NORMAL: normal}
        for name, image in textured.items():
            if self._wanted.sized and image is not None and image.ndim == 3:
                limit = f"one look at each part holds {self._enough} px"
                notes[f"{name} size"] = f"{len(image)} of {self._baked.texels.size} px; {limit}"
        for name, gain in self._gains.items():
            notes[f"{name} detail"] = (
                f"twice as many px show unseen views {gain:+.2f} dB better; "
                f"{FINER_PAYS_DB} dB would pay"
            )
        return MaterialMaps(
            basecolor=basecolor,
            orm=orm,
            orm_factor=factor_orm if self._wanted.nested else None,
            normal_tangent=normal,
            notes=notes,
        )

    def _basecolor(self, verdict: Verdict | None) -> Float[Tensor, "*basecolor 3"]:
        """One colour, or a picture."""
        if verdict is not None and verdict.chosen.form == "constant":
            return self._pixels.mean()[:3].clamp(0.0, 1.0)
        return self._image(BASECOLOR, verdict, self._sizes[BASECOLOR.name]).clamp(0.0, 1.0)

    def _orm(
        self, verdicts: dict[str, Verdict], notes: dict[str, str]
    ) -> tuple[Float[Tensor, "*orm 3"], Float[Tensor, "3"]]:
        """Occlusion, roughness and metallic with what multiplies them."""
        factor = torch.ones(3)
        mean = self._pixels.mean()
        hidden = float((1.0 - self._baked.occlusion).square().mean().sqrt())
        is_open = self._wanted.nested and hidden <= NO_OCCLUSION
        if self._wanted.nested:
            notes[OCCLUSION] = (
                f"{'left out' if is_open else 'texture'}: {hidden:.4f} of the sky is hidden "
                f"(RMS), {NO_OCCLUSION:.4f} would not be seen"
            )
        drawn = [] if is_open else [OCCLUSION]
        for place, group in ((1, ROUGHNESS), (2, METALLIC)):
            verdict = verdicts.get(group.name)
            if verdict is not None and verdict.chosen.form == "constant":
                factor[place] = mean[group.places].clamp(0.0, 1.0)[0]
            else:
                drawn.append(group.name)
        if not drawn:
            return factor, torch.ones(3)
        size = max(self._sizes[name] for name in drawn)
        planes = [torch.ones(size, size, 1) for _ in range(3)]
        if OCCLUSION in drawn:
            planes[0] = self._averaged(self._baked.occlusion, size)
        for place, group in ((1, ROUGHNESS), (2, METALLIC)):
            if group.name in drawn:
                planes[place] = self._image(group, verdicts.get(group.name), size)
        return torch.cat(planes, -1).clamp(0.0, 1.0), factor

    def _image(self, group: Channels, verdict: Verdict | None, size: int) -> Float[Tensor, "S S c"]:
        """A picture of all texels' values, or of a palette's."""
        image = self._averaged(self._baked.surface[:, group.places], size)
        flat = image.reshape(size * size, -1)
        pixels = self._pixels_at(size).of(group.places)
        if verdict is None or verdict.chosen.form != "palette":
            if size == self._baked.texels.size or not self._wanted.sharpened:
                return image
            # Averaged texels, read bilinearly, blur: the views are asked for sharper ones again.
            fitted = fit_texels(
                pixels.operator,
                pixels.target,
                pixels.weight,
                flat,
                prior=self._wanted.prior,
                iterations=self._wanted.sharpened,
            )
            shown = torch.zeros(size * size, dtype=torch.bool)
            texels = self._baked.texels
            row, column = texels.pixel // texels.size, texels.pixel % texels.size
            factor = texels.size // size
            shown[row // factor * size + column // factor] = True
            return fill_empty(fitted.view(size, size, -1), shown.view(size, size))
        seen = group.curve(flat.clamp(0.0, 1.0))
        palette, mass = None, pixels.mass()
        for grown in growing_palettes(seen, mass, verdict.chosen.clusters):
            palette = grown
        if palette is None:  # at this size the texels are all alike
            return image
        labels, clusters = palette.labels(seen), len(palette.values)
        values = palette_values(labels, clusters, flat, mass, pixels)
        return values[labels].view(size, size, -1)

    def _averaged(self, values: Float[Tensor, "P C"], size: int) -> Float[Tensor, "S S C"]:
        """A picture of a given size."""
        return to_image(*average_down(values, self._baked.texels, self._baked.texels.size // size))

    def _normal_map(self, notes: dict[str, str]) -> Float[Tensor, "S S 3"] | None:
        """The map, or None where the mesh's own normals say as much."""
        if self._wanted.nested and self._is_flat(notes):
            return None
        return normalize(self._averaged(self._baked.local, self._sizes[NORMAL]))

    def _is_flat(self, notes: dict[str, str]) -> bool:
        """Whether the views' normals pay for a map; the map was not fitted to them."""
        pixels, errors = self._pixels, {}
        target = normalize(self._normals.reshape(-1, 3)[pixels.pixel])
        weight = pixels.weight.double()
        residual = torch.zeros_like(target)
        for name, world in zip(("mesh", "map"), self._baked.world_normals(), strict=True):
            image = to_image(world, self._baked.texels).reshape(-1, 3)
            residual = normalize(pixels.operator(image)) - target
            squared = (weight * residual.square().sum(1, keepdim=True)).sum()
            errors[name] = float(squared / weight.sum().clamp_min(1e-12))
        count = pixels.independent(residual)
        free = {"mesh": 1, "map": self._counts[NORMAL]}
        costs = {
            name: cost(error, count, free[name], NORMAL_FLOOR_RAD**2)
            for name, error in errors.items()
        }
        # Whatever it costs, a map stays that turns what is seen by more than may go unnoticed.
        turned = math.sqrt(max(errors["mesh"] - errors["map"], 0.0))
        is_flat = costs["mesh"] <= costs["map"] and turned <= NORMAL_FLOOR_RAD
        told = ", ".join(
            f"{name} {math.degrees(math.sqrt(error)):.2f} deg, cost {costs[name]:.0f}"
            for name, error in errors.items()
        )
        form = "the mesh's own" if is_flat else "texture"
        notes[NORMAL] = f"{form} by {count:.0f} independent pixels ({told})"
        return is_flat
