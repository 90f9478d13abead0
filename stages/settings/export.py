"""Settings of the export stage."""

from stages.settings.base import StageConfig


class ExportConfig(StageConfig):
    """The finished files."""
