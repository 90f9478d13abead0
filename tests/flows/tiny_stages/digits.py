"""Reads numbers from a text file."""

from pathlib import Path

import torch
from tiny_stages.numbers import Numbers

from stages.base import Context, Stage
from stages.errors import InputError
from stages.settings.base import StageConfig


def run(source: Path, *, config: StageConfig, ctx: Context) -> Numbers:
    """One number per word."""
    try:
        return Numbers(torch.tensor([float(word) for word in source.read_text().split()]))
    except ValueError as error:
        raise InputError(f"{source}: {error}; write numbers") from error


DIGITS = Stage(run)
