"""When a phase has learnt what it can: its schedule goes on at its next part.

A loss is looked at in windows of a sixteenth of the steps. Where the mean of one is below that of
the window before by less than a share, over two windows, and a quarter of the steps has passed, the
rest of this part of the schedule is left out. Nothing is cut off: grids still grow and rates still
cool, for the last part is never left out.
"""

from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor

from stages.base import Context
from stages.settings.dmtet import DmtetConfig
from stages.settings.nerf import NerfConfig
from svim3d.render.pixel_blocks import PixelBlocks

WINDOWS = 16  # in the whole schedule
LEAST_SHARE = 0.25  # of the steps that are always made
PATIENCE = 2  # windows over which a fall is measured: one alone is too noisy
COOLING = 0.85  # share of the schedule at which the last part begins
UNSEEN = 0.01  # mean difference of a normal's components that is not noticed: about 1 degree
TINY = 1e-12  # a loss of nothing falls no further
HELD_OUT = 256  # blocks that are looked at: a quarter of a thousand rays, of thousands in a step
SOLID = 0.99  # coverage of a pixel that holds no background
HISTORY = "plateau.history"


class Plateau:
    """The place in a schedule, moved on where the loss has stopped falling.

    Args:
        steps: of the whole schedule.
        least_fall: share by which the loss has to fall from window to window; 0: nothing is
            watched and every step is made.
        parts: shares of the schedule at which its parts begin, ascending.
        window: steps that a window has at least.
        unseen: a loss that nobody would notice; it is added, so that what falls from little to
            less does not count.
    """

    def __init__(
        self,
        steps: int,
        least_fall: float,
        parts: Sequence[float] = (),
        *,
        window: int = 1,
        unseen: float = 0.0,
    ) -> None:
        self._steps, self._least_fall, self._unseen = steps, least_fall, unseen
        starts = [share for share in parts if 0.0 < share < COOLING]
        self._parts = [round(share * steps) for share in (*starts, COOLING)]
        # Whole multiples of the least window see the same views.
        self._window = window * max(1, round(steps / WINDOWS / window))
        self._seen: list[tuple[int, float]] = []  # of this part: step and loss
        self._made = 0

    @classmethod
    def of(
        cls, config: NerfConfig | DmtetConfig, parts: Sequence[float] = (), *, window: int
    ) -> Self:
        """The place in a phase's schedule; see the class."""
        unseen = UNSEEN * config.normal_weight
        return cls(config.steps, config.least_fall, parts, window=window, unseen=unseen)

    @property
    def is_watched(self) -> bool:
        """Whether losses are of any use."""
        return self._least_fall > 0.0

    def held_out(self, blocks: PixelBlocks, ctx: Context) -> tuple[PixelBlocks, PixelBlocks]:
        """Blocks to look at, and those to fit: all of them if nothing is watched."""
        if not self.is_watched:
            return blocks.take(torch.arange(0, device=blocks.pixels.device)), blocks
        # At an outline one ray through a pixel's centre is farther from the pixel's mean the
        # sharper the surface becomes, however well it is placed.
        solid = torch.nonzero(blocks.targets["mask"].amin((1, 2)) >= SOLID)[:, 0]
        order = torch.randperm(len(solid), generator=ctx.generator("held out"))
        chosen = solid[order[: min(HELD_OUT, len(solid) // 2)].to(solid.device)]
        fitted = torch.ones(len(blocks), dtype=torch.bool, device=solid.device)
        fitted[chosen] = False
        return blocks.take(chosen), blocks.take(fitted)

    def observe(self, step: int, loss: float) -> None:
        """What the loss is before a step."""
        if self.is_watched:
            self._seen.append((step, loss + self._unseen))

    def after(self, step: int, ctx: Context) -> int:
        """The step that comes next."""
        self._made += 1
        following = next((part for part in self._parts if part > step + 1), None)
        fall = self._fall(step)
        is_early = step + 1 < LEAST_SHARE * self._steps
        if following is None or fall is None or is_early or fall >= self._least_fall:
            return step + 1
        ctx.event(
            "plateau",
            f"step {step}: in {self._window} steps the loss has fallen by {fall:.1%}, so the "
            f"schedule goes on at step {following}",
            tell=False,
        )
        self._seen.clear()
        return following

    def _fall(self, step: int) -> float | None:
        """Relative fall per window over the last ones; None while they are not full."""
        if not self._seen or self._seen[0][0] > step + 1 - (PATIENCE + 1) * self._window:
            return None
        means: list[float] = []
        for window in range(PATIENCE + 1):
            end = step + 1 - window * self._window
            inside = [loss for at, loss in self._seen if end - self._window <= at < end]
            if not inside:
                return None
            means.append(sum(inside) / len(inside))
        return 1.0 - (means[0] / max(means[-1], TINY)) ** (1.0 / PATIENCE)

    def tell(self, ctx: Context) -> None:
        """Leave a note of the steps that were made, where they could have been fewer."""
        if not self.is_watched:
            return
        because = f"a loss that falls by less than {self._least_fall:.1%} has no use for more"
        ctx.event("capacity", f"steps {self._made} of {self._steps}: {because}", tell=False)

    def state(self) -> dict[str, Tensor]:
        """Everything that the next step depends on."""
        if not self.is_watched:
            return {}
        rows = [(float(self._made), 0.0), *((float(at), loss) for at, loss in self._seen)]
        return {HISTORY: torch.tensor(rows, dtype=torch.float64)}

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        """Take over what `state` gave."""
        if not self.is_watched:
            return
        (made, _), *rows = tensors[HISTORY].tolist()
        self._made, self._seen = int(made), [(int(at), loss) for at, loss in rows]
