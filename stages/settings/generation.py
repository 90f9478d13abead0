"""Settings of the generation stage."""

from stages.settings.base import StageConfig


class GenerationConfig(StageConfig):
    """Where the views come from and how they are made."""
