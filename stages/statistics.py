"""Means and intervals for what compares runs, from the library: flows see stages alone."""

from svim3d.metrics.statistics import (
    Interval,
    SampleSummary,
    bootstrap_interval,
    mean_and_interval,
    paired,
    paired_interval,
    summarize_samples,
)

__all__ = [
    "Interval",
    "SampleSummary",
    "bootstrap_interval",
    "mean_and_interval",
    "paired",
    "paired_interval",
    "summarize_samples",
]
