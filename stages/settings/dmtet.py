"""Settings of the dmtet stage."""

from stages.settings.base import StageConfig


class DmtetConfig(StageConfig):
    """Phase 2, the refined surface."""
