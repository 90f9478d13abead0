"""The generator as a whole: one picture and a list of cameras in, views with materials out."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

from svim3d.diffusion.autoencoder import (
    PICTURES_AT_A_TIME,
    Autoencoder,
    build_autoencoder,
    decode,
    encode,
)
from svim3d.diffusion.conditioning import (
    Conditioning,
    Shrinking,
    camera_numbers,
    embed_picture,
    shrink_picture,
)
from svim3d.diffusion.expectation import Expectation
from svim3d.diffusion.groups import GROUPS, GeneratedViews, as_network_input, unpack
from svim3d.diffusion.guidance import (
    GuidanceInterval,
    guide,
    weights_by_azimuth,
    weights_by_index,
)
from svim3d.diffusion.karras import c_in, c_noise, denoised, noise_levels
from svim3d.diffusion.look import Look, with_means
from svim3d.diffusion.prepared import PreparedUNet
from svim3d.diffusion.sampler import Denoiser, sample, seeded_noise
from svim3d.diffusion.unet import MaterialVideoUNet


@dataclass(frozen=True)
class ModelSpec:
    """Everything about a model that is not a weight.

    Attributes:
        name: what its card calls it.
        image_size: side of its pictures, pixels.
        views: frames of a clip.
        fov_deg: vertical field of view of all cameras.
        groups: order of the pictures' channels in a latent.
        latent_scale: brings the autoencoder's latents to unit variance.
        sigma_min: smallest noise level of a sampler, before 0.
        sigma_max: largest.
        rho: how unevenly levels are spread.
        steps: of the sampler, unless asked for others.
        guidance_min: strength at the reference view.
        guidance_max: strength behind.
        cond_aug: noise that the network believes to be on the reference view.
        shrink: how the image encoder's picture was made smaller in training.
        unet: arguments of `MaterialVideoUNet`.
        autoencoder: arguments of diffusers' `AutoencoderKL` or of `PatchAutoencoder`.
        image_encoder: arguments of transformers' `CLIPVisionConfig`.
        expectation: arguments of `Expectation` beyond those that follow from the others; None for a
            model that diffuses latents themselves.
        residual_scale: what an expectation leaves open, as a standard deviation of latents.
        normal_length: of the normals it decodes inside an object; a model that hesitates answers
            with means of directions, which are shorter than 1.
        look: arguments of `Look`; None for a model that draws roughness and metallic alone.
        look_detail: share of the drawn differences that is kept where a look tells the means.
    """

    name: str
    image_size: int
    views: int
    fov_deg: float
    latent_scale: float
    sigma_max: float
    steps: int
    guidance_max: float
    unet: dict[str, Any]
    autoencoder: dict[str, Any]
    image_encoder: dict[str, Any]
    guidance_min: float = 1.0
    sigma_min: float = 0.002
    rho: float = 7.0
    cond_aug: float = 1e-5
    shrink: Shrinking = "antialias"
    groups: tuple[str, ...] = field(default=GROUPS)
    expectation: dict[str, Any] | None = None
    residual_scale: float = 1.0
    normal_length: float = 1.0
    look: dict[str, Any] | None = None
    look_detail: float = 1.0

    @property
    def latent_side(self) -> int:
        """Side of a latent picture."""
        if "patch" in self.autoencoder:
            return int(self.image_size // self.autoencoder["patch"])
        return int(self.image_size // 2 ** (len(self.autoencoder["block_out_channels"]) - 1))

    @property
    def latent_channels(self) -> int:
        """Channels of one group's latent."""
        return int(self.autoencoder["latent_channels"])


# SV3D_p with four groups. Source: SV3D's configuration files; SViM3D, section 4.
PAPER = ModelSpec(
    name="svim3d-576",
    image_size=576,
    views=21,
    fov_deg=33.8,
    latent_scale=0.18215,
    sigma_max=700.0,
    steps=50,
    guidance_max=2.5,
    shrink="blur",
    unet={
        "in_channels": 20,
        "out_channels": 16,
        "block_out_channels": [320, 640, 1280, 1280],
        "num_attention_heads": [5, 10, 20, 20],
        "layers_per_block": 2,
        "cross_attention_dim": 1024,
        "addition_time_embed_dim": 256,
        "attention": [True, True, True, False],
    },
    autoencoder={
        "block_out_channels": [128, 256, 512, 512],
        "down_block_types": ["DownEncoderBlock2D"] * 4,
        "up_block_types": ["UpDecoderBlock2D"] * 4,
        "latent_channels": 4,
        "layers_per_block": 2,
        "sample_size": 576,
    },
    image_encoder={
        "hidden_size": 1280,
        "intermediate_size": 5120,
        "num_hidden_layers": 32,
        "num_attention_heads": 16,
        "projection_dim": 1024,
        "image_size": 224,
        "patch_size": 14,
        "hidden_act": "gelu",
    },
)


@dataclass(frozen=True)
class Sampling:
    """How an orbit is drawn.

    Attributes:
        steps: of the sampler; None takes the model's own.
        guidance_max: strength of guidance behind the object; None takes the model's own.
        guidance_by: how guidance grows: with the frame's index, or with its azimuth.
        interval: noise levels at which guidance acts.
        decode_at_once: pictures that the autoencoder decodes together.
        compiled: compile the network's blocks, see `PreparedUNet`.
    """

    steps: int | None = None
    guidance_max: float | None = None
    guidance_by: Literal["index", "azimuth"] = "index"
    interval: GuidanceInterval = field(default_factory=GuidanceInterval)
    decode_at_once: int = PICTURES_AT_A_TIME
    compiled: bool = False


class MaterialDiffusion:
    """UNet, autoencoder, image encoder, expectation and look, and how to draw an orbit with them.

    Args:
        spec: what the weights are for.
        unet: sees frames together.
        autoencoder: sees one picture of one group at a time.
        image_encoder: sees the reference view.
        expectation: what the UNet's latents are residuals of, if they are.
        look: tells mean roughness and metallic, if there is one.
    """

    def __init__(
        self,
        spec: ModelSpec,
        unet: MaterialVideoUNet,
        autoencoder: Autoencoder,
        image_encoder: CLIPVisionModelWithProjection,
        expectation: Expectation | None = None,
        look: Look | None = None,
    ) -> None:
        self.spec = spec
        self.unet = unet
        self.autoencoder = autoencoder
        self.image_encoder = image_encoder
        self.expectation = expectation
        self.look = look

    @classmethod
    def untrained(cls, spec: ModelSpec) -> "MaterialDiffusion":
        """With random weights, on torch's current default device."""
        return cls(
            spec,
            MaterialVideoUNet(**spec.unet),
            build_autoencoder(spec.autoencoder),
            CLIPVisionModelWithProjection(CLIPVisionConfig(**spec.image_encoder)),
            None
            if spec.expectation is None
            else Expectation(
                latent_channels=spec.latent_channels,
                side=spec.latent_side,
                picture_side=int(spec.image_encoder["image_size"]),
                groups=len(spec.groups),
                **spec.expectation,
            ),
            None if spec.look is None else Look(**spec.look),
        )

    def described(self, **changes: Any) -> "MaterialDiffusion":
        """The same networks under a description with other values."""
        return MaterialDiffusion(replace(self.spec, **changes), **self.parts)  # type: ignore[arg-type]

    @property
    def parts(self) -> dict[str, torch.nn.Module]:
        """The networks by the names of their files."""
        names = ("unet", "autoencoder", "image_encoder", "expectation", "look")
        parts = {name: getattr(self, name) for name in names}
        return {name: part for name, part in parts.items() if part is not None}

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return self.unet.conv_in.weight.device

    @torch.no_grad()
    def condition(
        self,
        picture: Float[Tensor, "H W 3"],
        elevation_deg: Float[Tensor, "K"],
        azimuth_deg: Float[Tensor, "K"],
    ) -> Conditioning:
        """What the network is told of a picture and of cameras.

        Args:
            picture: the reference view over white, display-referred, in [0, 1], square.
            elevation_deg: absolute, of each frame.
            azimuth_deg: of each frame; the last frame is the reference view.
        """
        side = self.spec.image_size
        pictures = as_network_input(picture[None]).to(self.device, torch.float32)
        if pictures.shape[-1] != side:
            pictures = functional.interpolate(
                pictures, size=(side, side), mode="bicubic", align_corners=False, antialias=True
            ).clamp(-1.0, 1.0)
        camera = camera_numbers(elevation_deg, azimuth_deg, self.spec.cond_aug)
        small = shrink_picture(pictures, self.image_encoder.config.image_size, self.spec.shrink)
        return Conditioning(
            token=embed_picture(self.image_encoder, small).float(),
            latent=encode(self.autoencoder, pictures),
            camera=camera[None].to(self.device, torch.float32),
            picture=small,
        )

    @torch.no_grad()
    def draw(
        self,
        conditioning: Conditioning,
        seed: int,
        sampling: Sampling = Sampling(),
        report: Callable[[int, int], None] | None = None,
    ) -> Float[Tensor, "K c h w"]:
        """Latents of one orbit, all groups, of unit variance; same seed, same orbit."""
        spec, frames = self.spec, conditioning.camera.shape[1]
        side, channels = spec.latent_side, spec.latent_channels * len(spec.groups)
        noise = seeded_noise((1, frames, channels, side, side), seed, device=self.device)
        return sample(
            self.denoiser(conditioning, sampling), noise, self.noise_levels(sampling), report
        )[0]

    def noise_levels(self, sampling: Sampling) -> Float[Tensor, "steps_and_one"]:
        """Descending noise levels of a draw, the last of them 0."""
        spec = self.spec
        return noise_levels(
            spec.steps if sampling.steps is None else sampling.steps,
            sigma_min=spec.sigma_min,
            sigma_max=spec.sigma_max,
            rho=spec.rho,
        )

    @torch.no_grad()
    def denoiser(self, conditioning: Conditioning, sampling: Sampling) -> Denoiser:
        """The guided network, prepared for many steps on one orbit.

        Its plain twin: `denoise` without and with the reference view, and `guide` between them.
        """
        network = PreparedUNet(self.unet, compiled=sampling.compiled)
        weights = self.guidance(conditioning, sampling).to(self.device)
        guides = bool((weights != 1.0).any())
        branches = [conditioning, *([conditioning.beside_unconditional()] if guides else [])]
        ready = [(told, network.bind(told)) for told in map(self.expecting, branches)]

        def denoise(noisy: Tensor, sigma: float) -> Tensor:
            # Frames of weight 1 need the unconditional branch too: their neighbours see them in it.
            guided = guides and sampling.interval.holds(sigma)
            told, bound = ready[-1] if guided else ready[0]
            residual = self.residual(noisy, told)
            level = self._level(sigma)
            known = c_noise(level).to(self.device, torch.float32)
            answer = network(residual * float(c_in(level)), known, bound).to(noisy.dtype)
            residual = residual.expand_as(answer)
            clean = self.whole(
                denoised(residual, answer, level.expand(len(answer)).to(noisy)), told
            )
            if not guided:
                return clean
            without, given = clean.chunk(2)
            return guide(without, given, weights)

        return denoise

    @torch.no_grad()
    def expecting(self, conditioning: Conditioning) -> Conditioning:
        """The same, with what the model expects of it, if it is one that does."""
        if self.expectation is None:
            return conditioning
        assert conditioning.picture is not None
        weights = self.expectation.position.dtype
        expected = self.expectation(
            conditioning.latent.to(weights), conditioning.picture.to(weights), conditioning.camera
        )
        return replace(conditioning, expected=expected)

    def residual(
        self, latents: Float[Tensor, "n k c h w"], told: Conditioning
    ) -> Float[Tensor, "b k c h w"]:
        """What is diffused: latents less what is expected of them, of unit variance."""
        if told.expected is None:
            return latents
        return (latents - told.expected.to(latents)) / self.spec.residual_scale

    def whole(
        self, residual: Float[Tensor, "b k c h w"], told: Conditioning
    ) -> Float[Tensor, "b k c h w"]:
        """Latents from their residual."""
        if told.expected is None:
            return residual
        return told.expected.to(residual) + self.spec.residual_scale * residual

    def _level(self, sigma: float) -> Float[Tensor, "1"]:
        """The noise level that latents' noise is to their residual."""
        return torch.tensor([sigma / self.spec.residual_scale], dtype=torch.float64)

    def denoise(
        self, noisy: Float[Tensor, "b k c h w"], sigma: float, conditioning: Conditioning
    ) -> Float[Tensor, "b k c h w"]:
        """The clean latents that the network expects behind noisy ones."""
        told = self.expecting(conditioning)
        residual = self.residual(noisy, told)
        level = self._level(sigma).expand(len(noisy))
        weights = self.unet.conv_in.weight.dtype
        answer = self.unet(
            # Only what is noisy is scaled.
            told.beside(residual * float(c_in(level[0]))).to(weights),
            c_noise(level).to(noisy.device, torch.float32),
            told.token.to(weights),
            told.camera,
        )
        return self.whole(denoised(residual, answer.to(noisy.dtype), level.to(noisy)), told)

    @torch.no_grad()
    def decode(
        self,
        latents: Float[Tensor, "K c h w"],
        sampling: Sampling = Sampling(),
        conditioning: Conditioning | None = None,
    ) -> GeneratedViews:
        """The views that latents stand for, as `draw` gives them; a look asks the conditioning."""
        groups = latents.split(self.spec.latent_channels, 1)
        stacked = torch.cat(groups) / self.spec.latent_scale
        pictures = decode(self.autoencoder, stacked, sampling.decode_at_once).chunk(len(groups))
        named = dict(zip(self.spec.groups, pictures, strict=True))
        views = unpack(named, self.spec.normal_length)
        if self.look is None or conditioning is None:
            return views
        assert conditioning.picture is not None
        return with_means(views, self.look(conditioning.picture)[0], self.spec.look_detail)

    def guidance(self, conditioning: Conditioning, sampling: Sampling) -> Float[Tensor, "K"]:
        """Strength of guidance at each frame."""
        strongest = sampling.guidance_max
        strongest = self.spec.guidance_max if strongest is None else strongest
        strength = {"weakest": self.spec.guidance_min, "strongest": strongest}
        camera = conditioning.camera[0]
        if sampling.guidance_by == "index":
            return weights_by_index(len(camera), **strength)
        return weights_by_azimuth(torch.rad2deg(camera[:, 2]).cpu(), **strength)
