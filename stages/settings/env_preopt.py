"""Settings of the env_preopt stage."""

from stages.settings.base import StageConfig


class EnvPreoptConfig(StageConfig):
    """Phase 0, the environment from the views."""
