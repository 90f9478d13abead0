"""How long a stage may run, as `--timeout` says."""

import math
from collections.abc import Iterable, Sequence

from stages.errors import InputError


def parse_limits(given: Iterable[str], stages: Sequence[str]) -> dict[str, float]:
    """Seconds by stage of `60` (any stage) or `nerf=600`; the named ones count more.

    Raises:
        InputError: no such stage, or no time.
    """
    general: dict[str, float] = {}
    named: dict[str, float] = {}
    for text in given:
        stage, is_named, seconds = text.rpartition("=")
        try:
            limit_s = float(seconds)
        except ValueError:
            limit_s = math.nan
        if not (limit_s > 0.0 and math.isfinite(limit_s)):
            raise InputError(f"--timeout {text}: wanted seconds like 600, or STAGE=SECONDS")
        if is_named and stage not in stages:
            raise InputError(f"--timeout {text}: no such stage; choose from {', '.join(stages)}")
        if is_named:
            named[stage] = limit_s
        else:
            general = dict.fromkeys(stages, limit_s)
    return general | named
