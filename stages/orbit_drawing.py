"""An orbit drawn of one photo: the generator's views, chosen, scaled and put into the world.

The generator knows no distances: its cameras look at the origin from as far as makes the object's
longest side 1, found by its silhouettes (`svim3d.render.orbit_scale`).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from stages.artifacts import MaterialViews
from stages.base import Context
from stages.photo_artifact import PreparedPhoto
from stages.settings.generation import GenerationConfig
from svim3d.cameras import Cameras, orbit_angles, orbit_cameras
from svim3d.diffusion.agreement import choose
from svim3d.diffusion.groups import GROUPS, GeneratedViews
from svim3d.diffusion.guidance import GuidanceInterval
from svim3d.diffusion.model import MaterialDiffusion, Sampling
from svim3d.diffusion.photo_view import enlarged, resized, with_photo
from svim3d.io.model_folder import bundled_model, read_model
from svim3d.io.orbit_repair import MAX_SHARE_OUTSIDE, admit_views, share_outside
from svim3d.render.orbit_scale import longest_side

CLOSER = 0.98  # factor on the cameras' distance while views stick out of the object's cube
CLOSEST = 1.0  # world units; nearer ones would soon stand inside the cube


def views_of_photo(
    photo: PreparedPhoto, *, config: GenerationConfig, ctx: Context
) -> MaterialViews:
    """Draw views around the object of a photo.

    Raises:
        ValueError: there is no model, or what it draws is no object before a background.
    """
    dtype = _dtype(config, ctx.device)
    folder = config.model or bundled_model()
    model = read_model(folder, ctx.device, dtype)
    if set(model.spec.groups) != set(GROUPS):
        raise ValueError(
            f"wanted a model of the groups {', '.join(GROUPS)}, {folder} has "
            f"{', '.join(model.spec.groups)} alone; convert it with --groups 4 and train it"
        )
    angles = camera_path(config, model.spec.views)
    samples = draw_samples(model, photo, angles, config, ctx)
    confidence = None
    best = samples[0]
    if len(samples) > 1:
        chosen, confidence = choose(samples)
        best = samples[chosen]
        ctx.event(
            "sample_chosen",
            f"sample {chosen} of {len(samples)} is nearest to their mean; mean confidence of the "
            f"object's pixels {float(confidence[best.mask > 0.5].mean()):.2f}",
        )
    if config.keep_photo:
        size = max(config.photo_view_size, best.mask.shape[1])
        best = with_photo(enlarged(best, size), photo.rgb, photo.mask)
        confidence = _photo_confidence(best.mask, confidence, config.photo_weight)
    try:
        cameras = place_cameras(best, angles, model.spec.fov_deg)
        cameras, images, reference = admit_views(
            cameras, _images(best, cameras, confidence), len(cameras) - 1, ctx.event
        )
    except ValueError as error:
        raise ValueError(
            f"the views that the generator drew cannot be used ({error}); try another --seed, or a "
            "photo that shows the whole object on its own"
        ) from error
    return MaterialViews(cameras=cameras, reference=reference, **images)


def camera_path(config: GenerationConfig, views: int) -> list[tuple[float, float]]:
    """Elevation and azimuth of each camera, degrees; the last one is the photo's."""
    if config.path == "list":
        return [(elevation, azimuth % 360.0) for elevation, azimuth in config.angles]
    swing = config.swing_deg if config.path == "sine" else 0.0
    return orbit_angles(views, config.elevation_deg, swing)


def draw_samples(
    model: MaterialDiffusion,
    photo: PreparedPhoto,
    angles: list[tuple[float, float]],
    config: GenerationConfig,
    ctx: Context,
) -> list[GeneratedViews]:
    """Orbits of one photo; each depends on the run's seed and its own number alone."""
    elevation, azimuth = torch.tensor(angles).unbind(1)
    over_white = photo.rgb * photo.mask + (1.0 - photo.mask)
    conditioning = model.condition(over_white, elevation, azimuth)
    sampling = Sampling(
        steps=config.sampler_steps,
        guidance_max=config.guidance_max,
        guidance_by=config.guidance_by or ("azimuth" if config.path == "list" else "index"),
        interval=GuidanceInterval(*(config.guidance_interval or ())),
        compiled=config.compiled,
    )
    samples = []
    for number in range(config.samples):

        def report(step: int, steps: int, before: int = number) -> None:
            ctx.report(before * steps + step, config.samples * steps, {"sample": before + 1})

        seed = ctx.generator(f"sample {number}").initial_seed()
        latents = model.draw(conditioning, seed, sampling, report)
        if not torch.isfinite(latents).all():
            raise ValueError(
                "the generator's numbers are not finite; try --set generation.dtype=float32, or a "
                "weaker --set generation.guidance_max"
            )
        samples.append(_on_cpu(model.decode(latents, sampling, conditioning)))
    return samples


def place_cameras(
    views: GeneratedViews, angles: list[tuple[float, float]], fov_y_deg: float
) -> Cameras:
    """Cameras at the distance at which the object's longest side is 1.

    Where silhouettes contradict each other, closer: as the object's cube is to hold all of it.
    """
    size = views.mask.shape[1]
    near = orbit_cameras(angles, radius=1.0, fov_y_deg=fov_y_deg, size=size)
    radius = 1.0 / longest_side(near, views.mask, views.normal_camera)
    cameras = orbit_cameras(angles, radius=radius, fov_y_deg=fov_y_deg, size=size)
    while radius > CLOSEST and share_outside(cameras, views.mask) > MAX_SHARE_OUTSIDE:
        radius *= CLOSER
        cameras = orbit_cameras(angles, radius=radius, fov_y_deg=fov_y_deg, size=size)
    return cameras


def _dtype(config: GenerationConfig, device: torch.device) -> torch.dtype:
    if config.dtype == "auto":
        return torch.bfloat16 if device.type == "cuda" else torch.float32
    return torch.bfloat16 if config.dtype == "bfloat16" else torch.float32


def _on_cpu(views: GeneratedViews) -> GeneratedViews:
    return GeneratedViews(**{name: image.float().cpu() for name, image in vars(views).items()})


def _photo_confidence(
    mask: Float[Tensor, "K H W 1"], drawn: Float[Tensor, "K h w 1"] | None, weight: float
) -> Float[Tensor, "K H W 1"] | None:
    """Confidence of views of which the last is the photo's own."""
    if drawn is None and weight == 1.0:
        return None
    trust = torch.ones_like(mask) if drawn is None else resized(drawn, mask.shape[1])
    trust[-1] = weight
    return trust


def _images(
    views: GeneratedViews, cameras: Cameras, confidence: Float[Tensor, "K H W 1"] | None
) -> dict[str, Tensor]:
    """The images of an orbit, as a reload of their half floats reads them."""
    normal = torch.einsum("kij,khwj->khwi", cameras.c2w[:, :3, :3], views.normal_camera)
    images = {
        "radiance": views.rgb_linear * views.mask,
        "mask": views.mask,
        "basecolor": views.basecolor,
        "roughness": views.roughness,
        "metallic": views.metallic,
        "normal_world": normal,
        **({} if confidence is None else {"confidence": confidence}),
    }
    return {name: image.half().float() for name, image in images.items()}
