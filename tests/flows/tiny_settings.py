"""Settings of the tiny stages, apart from the stages so that a plan needs no torch."""

from typing import Literal

from stages.settings.base import StageConfig


class WalkConfig(StageConfig):
    """How far to walk, and what goes wrong."""

    steps: int = 40
    pause_s: float = 0.0
    fault: Literal[
        "",
        "transient",
        "memory",
        "cuda memory",
        "io",
        "input",
        "defect",
        "killed",
        "lost interrupt",
    ] = ""
    faults: int = 1
