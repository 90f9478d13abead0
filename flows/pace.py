"""How long a stage will still take, by the steps that it has done."""

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stages.base import Progress


class Pace:
    """Follows the reports of one run, whose stages come one after the other."""

    def __init__(self) -> None:
        self._stage = ""
        self._step = 0
        self._first_step = 0
        self._first_s = 0.0

    def left_s(self, progress: "Progress") -> float | None:
        """Seconds until the stage's last step; None until two reports have been seen.

        A resumed stage begins in its midst, and one that is tried again goes back: only steps
        between reports that follow each other count.
        """
        now = time.monotonic()
        if progress.stage != self._stage or progress.step < self._step:
            self._stage, self._first_step, self._first_s = progress.stage, progress.step, now
        self._step = progress.step
        done = progress.step - self._first_step
        if done == 0:
            return None
        return (progress.total - progress.step) * (now - self._first_s) / done
