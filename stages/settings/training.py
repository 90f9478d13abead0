"""Settings of training."""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from stages.settings.base import StageConfig

Share = Annotated[float, Field(ge=0.0, le=1.0)]
Precision = Literal["auto", "float32", "bfloat16"]


class AutoencoderTrainingConfig(StageConfig):
    """From pictures to latents and back, for a model with a small autoencoder of its own."""

    steps: PositiveInt = 3000
    """Optimiser steps."""
    batch: PositiveInt = 32
    """Pictures of a step, of all groups alike."""
    rate: PositiveFloat = 1e-3
    """Adam's step after warming up; it falls to a hundredth along a cosine."""
    edge_weight: NonNegativeFloat = 1.0
    """Weight of differences between neighbouring pixels."""
    objects: PositiveInt = 400
    """Examples kept in memory at once; later ones are passed over."""
    precision: Precision = "auto"
    """Of matrix products: `auto` takes bfloat16 where the device multiplies it."""


class LatentsConfig(StageConfig):
    """What the generator learns from, computed once."""

    white_share: Share = 0.5
    """Share of clips over white; the others stand before a random colour."""
    mirrored: bool = True
    """Whether every other light sees the object mirrored, which doubles the shapes."""


class ExpectationTrainingConfig(StageConfig):
    """The regression whose residual the generator diffuses, of a model that has one."""

    steps: PositiveInt = 8000
    """Optimiser steps of a model that is trained from nothing."""
    steps_on: NonNegativeInt = 0
    """The same of a model folder that is trained on; 0 leaves its expectation as it is."""
    batch: PositiveInt = 64
    """Clips of a step."""
    rate: PositiveFloat = 1e-3
    """Adam's step after warming up; it falls to a hundredth along a cosine."""
    warm_up: PositiveInt = 200
    """Steps over which the rate rises."""
    clip: PositiveFloat = 1.0
    """Largest norm of a step's gradient."""
    material_weight: NonNegativeFloat = 0.0
    """Weight of absolute differences of decoded roughness and metallic; latents hardly tell them
    from all else, so that squared errors of latents alone leave them at their mean."""
    drop_share: Share = 0.1
    """Share of clips that do not see the reference view."""
    precision: Precision = "auto"
    """Of matrix products: `auto` takes bfloat16 where the device multiplies it."""


class LookTrainingConfig(StageConfig):
    """Mean roughness and metallic from a picture's statistics, of a model that has a look."""

    steps: NonNegativeInt = 2000
    """Optimiser steps; 0 leaves the look as it is."""
    batch: PositiveInt = 256
    """Pictures of a step."""
    rate: PositiveFloat = 2e-3
    """Adam's step after warming up; it falls to a hundredth along a cosine."""
    noise: NonNegativeFloat = 0.3
    """On the statistics, in standard deviations: keeps a few thousand objects from being learnt
    by heart."""
    every_view: PositiveInt = 5
    """Views of an orbit that are learnt from, in each light: neighbours look alike."""


class GeneratorTrainingConfig(StageConfig):
    """The UNet and, if asked for, the image encoder."""

    phase_1_steps: NonNegativeInt = 100_000
    """Steps with temporal attention frozen, on all examples. Source: SViM3D, section 4."""
    phase_2_steps: NonNegativeInt = 60_000
    """Steps with everything free, on examples of good materials."""
    batch: PositiveInt = 2
    """Clips of a step."""
    rate_1: PositiveFloat = 3e-5
    """Adam's step in phase 1. Source: SVD, appendix D."""
    rate_2: PositiveFloat = 1e-5
    """The same in phase 2."""
    warm_up: PositiveInt = 200
    """Steps over which the rate rises, in each phase."""
    final_rate: Share = 1.0
    """Share of `rate_2` that is left at the end of phase 2; it falls along a cosine."""
    clip: PositiveFloat = 1.0
    """Largest norm of a step's gradient."""
    decay: Share = 0.9999
    """Of the moving average that is shipped."""
    noise_mean: float = 1.0
    """Mean of ln sigma. Source: SVD, appendix D, image to video at 576 x 1024."""
    noise_spread: PositiveFloat = 1.6
    """Standard deviation of ln sigma."""
    drop_share: Share = 0.1
    """Share of clips that do not see the reference view."""
    precision: Precision = "auto"
    """Of matrix products: `auto` takes bfloat16 where the device multiplies it."""
    gradient_checkpointing: bool = False
    """Recompute activations on the way back: a third more time, far less memory."""
    checkpoint_every_s: PositiveFloat = 120.0
    """Seconds between checkpoints."""
    sheet_every_s: PositiveFloat = 600.0
    """Seconds between sheets of sampled orbits."""


class TrainingConfig(StageConfig):
    """Settings of all parts of training."""

    autoencoder: AutoencoderTrainingConfig = AutoencoderTrainingConfig()
    latents: LatentsConfig = LatentsConfig()
    expectation: ExpectationTrainingConfig = ExpectationTrainingConfig()
    look: LookTrainingConfig = LookTrainingConfig()
    generator: GeneratorTrainingConfig = GeneratorTrainingConfig()
