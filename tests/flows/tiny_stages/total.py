"""Adds what there is."""

import torch
from tiny_stages.numbers import Numbers

from stages.base import Context, Stage
from stages.settings.base import StageConfig


def run(numbers: Numbers, walked: Numbers | None, *, config: StageConfig, ctx: Context) -> Numbers:
    """The sum of the walked numbers, or of those that never walked."""
    if walked is None:
        ctx.event("no_walk", "the numbers stay where they were")
    return Numbers(torch.sum((walked or numbers).values)[None])


TOTAL = Stage(run)
