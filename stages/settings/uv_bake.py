"""Settings of the uv_bake stage."""

from stages.settings.base import StageConfig


class UvBakeConfig(StageConfig):
    """Phase 3, atlas and textures."""
