"""The video UNet: diffusers' Stable Video Diffusion blocks, told the camera of each frame.

Where Stable Video Diffusion embeds one vector per clip, SV3D embeds one per frame: the noise added
to the reference view, and the polar angle and azimuth of the camera. Everything else is stock, and
so are all parameter names.

Source: Voleti et al. 2024, SV3D, section 3 and appendix; Engelhardt et al. 2025, SViM3D, section 3.
"""

from typing import Any

import torch
from diffusers import UNetSpatioTemporalConditionModel
from diffusers.models.embeddings import Timesteps
from jaxtyping import Float
from torch import Tensor, nn

# The width of each angle's sinusoids, in units of that of the noise: 512 and 256 in SV3D.
ANGLE_WIDTH = 2
GROUP_NORM_EPS = 1e-5  # diffusers builds most of these norms with 1e-6, SV3D was trained with this


class MaterialVideoUNet(UNetSpatioTemporalConditionModel):  # type: ignore[misc]
    """Denoises the latents of all views of a clip together.

    Args:
        in_channels: noisy latents of all groups, then the reference view's latent.
        out_channels: of all groups.
        block_out_channels: width of each resolution, the finest first.
        num_attention_heads: at each resolution.
        layers_per_block: residual blocks at each resolution on the way down.
        cross_attention_dim: width of the reference view's token.
        addition_time_embed_dim: width of the sinusoids of the reference view's noise; each angle
            has twice as many.
        attention: which resolutions attend, the finest first.
    """

    def __init__(
        self,
        *,
        in_channels: int,
        out_channels: int,
        block_out_channels: list[int],
        num_attention_heads: list[int],
        layers_per_block: int,
        cross_attention_dim: int,
        addition_time_embed_dim: int,
        attention: list[bool],
    ) -> None:
        kinds = ["CrossAttn" if attends else "" for attends in attention]
        super().__init__(
            in_channels=in_channels,
            out_channels=out_channels,
            down_block_types=tuple(f"{kind}DownBlockSpatioTemporal" for kind in kinds),
            up_block_types=tuple(f"{kind}UpBlockSpatioTemporal" for kind in reversed(kinds)),
            block_out_channels=tuple(block_out_channels),
            num_attention_heads=tuple(num_attention_heads),
            layers_per_block=layers_per_block,
            cross_attention_dim=cross_attention_dim,
            addition_time_embed_dim=addition_time_embed_dim,
            projection_class_embeddings_input_dim=addition_time_embed_dim * (1 + 2 * ANGLE_WIDTH),
        )
        self.angle_proj = Timesteps(ANGLE_WIDTH * addition_time_embed_dim, True, 0)
        for name, module in self.named_modules():
            if isinstance(module, nn.GroupNorm) and not name.endswith(".norm"):
                module.eps = GROUP_NORM_EPS
        # diffusers makes the mixers' shares on the CPU whatever the default device is.
        self.to(self.conv_in.weight.device)

    def embed(
        self, noise_level: Float[Tensor, "b"], camera: Float[Tensor, "b k 3"]
    ) -> Float[Tensor, "b_k d"]:
        """One embedding per frame, of the clip's noise level and the frame's camera."""
        batch, frames, _ = camera.shape
        level = self.time_embedding(self.time_proj(noise_level).to(self.conv_in.weight.dtype))
        return level.repeat_interleave(frames, 0, output_size=batch * frames) + self.embed_camera(
            camera
        )

    def embed_camera(self, camera: Float[Tensor, "b k 3"]) -> Float[Tensor, "b_k d"]:
        """The part of the embedding that stays the same over all noise levels."""
        added_noise, polar, azimuth = camera.flatten(0, 1).unbind(1)
        sinusoids = torch.cat(
            [self.add_time_proj(added_noise), self.angle_proj(polar), self.angle_proj(azimuth)], 1
        )
        embedded: Tensor = self.add_embedding(sinusoids.to(self.conv_in.weight.dtype))
        return embedded

    def forward(
        self,
        sample: Float[Tensor, "b k c h w"],
        noise_level: Float[Tensor, "b"],
        token: Float[Tensor, "b 1 d"],
        camera: Float[Tensor, "b k 3"],
    ) -> Float[Tensor, "b k o h w"]:
        """Answer with v.

        Args:
            sample: scaled noisy latents of all groups, and the reference view's latent beside each.
            noise_level: `karras.c_noise` of each clip.
            token: embedding of the reference view.
            camera: per frame, see `conditioning.camera_numbers`.

        Raises:
            ValueError: sides that cannot be halved as often as the network does.
        """
        self.check_sides(sample)
        batch, frames = sample.shape[:2]
        whole: dict[str, Any] = {
            "temb": self.embed(noise_level, camera),
            "image_only_indicator": sample.new_zeros(batch, frames),
        }
        context = token.repeat_interleave(frames, 0, output_size=batch * frames)
        hidden = self.conv_in(sample.flatten(0, 1))
        skips = [hidden]
        for block in self.down_blocks:
            hidden, new = block(hidden_states=hidden, **whole, **_context(block, context))
            skips.extend(new)
        hidden = self.mid_block(hidden_states=hidden, encoder_hidden_states=context, **whole)
        for block in self.up_blocks:
            count = len(block.resnets)
            taken, skips = tuple(skips[-count:]), skips[:-count]
            hidden = block(
                hidden_states=hidden,
                res_hidden_states_tuple=taken,
                **whole,
                **_context(block, context),
            )
        answer: Tensor = self.conv_out(self.conv_act(self.conv_norm_out(hidden)))
        return answer.unflatten(0, (batch, frames))

    def check_sides(self, latents: Float[Tensor, "*b h w"]) -> None:
        """Refuse latents whose sides cannot be halved as often as the network does.

        Raises:
            ValueError: such sides.
        """
        halvings, sides = 2**self.num_upsamplers, tuple(latents.shape[-2:])
        if any(side % halvings for side in sides):
            raise ValueError(
                f"wanted latents whose sides are multiples of {halvings}, got {sides}; "
                "choose an image size to match"
            )

    def temporal_attention(self) -> list[nn.Parameter]:
        """Parameters of everything that lets frames attend to each other.

        The temporal transformers and the embedding of the frame index; what the first phase of
        training leaves alone. Temporal convolutions and mixers stay free.
        """
        names = ("temporal_transformer_blocks", "time_pos_embed")
        return [p for n, p in self.named_parameters() if any(name in n for name in names)]


def _context(block: nn.Module, context: Tensor) -> dict[str, Tensor]:
    """The reference view's token, for blocks that attend to it."""
    attends = getattr(block, "has_cross_attention", False)
    return {"encoder_hidden_states": context} if attends else {}
