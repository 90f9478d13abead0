"""Settings of the nerf stage."""

from stages.settings.base import StageConfig


class NerfConfig(StageConfig):
    """Phase 1, the field."""
