"""Distances of sets of pictures, from features that were kept object by object.

No picture and no network is in memory: a suite's sets are as large as their features.
"""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from stages.scores_artifact import FEATURES
from svim3d.io.weights import load_tensors
from svim3d.metrics.features import clip_similarity, cmmd, frechet_distance

CLIP = "clip"  # the network that gives `cmmd` and `clip_similarity`
SHOWN, TRUE = "shown", "true"
MIN_PICTURES = 2  # a single one has no spread


def set_figures(folders: Sequence[Path]) -> dict[str, dict[str, float]]:
    """Distances of the sets that all objects' pictures make together, by subject and figure.

    A figure is called after its network: `fid` is Inception's, `frechet_efficientnet` that of
    EfficientNet-Lite0, `cmmd` and `clip_similarity` are CLIP's. Fewer than two pictures have none.

    Args:
        folders: of scores.
    """
    held: dict[str, list[Tensor]] = {}
    for file in (folder / FEATURES for folder in folders):
        for name, rows in (load_tensors(file) if file.is_file() else {}).items():
            held.setdefault(name, []).append(rows)
    figures: dict[str, dict[str, float]] = {}
    for name in [n for n in held if n.endswith(f"/{SHOWN}")]:
        subject, network, _ = name.split("/")
        shown, true = (torch.cat(held[f"{subject}/{network}/{s}"]) for s in (SHOWN, TRUE))
        found = figures.setdefault(subject, {})
        if len(shown) < MIN_PICTURES:
            continue
        if network == CLIP:
            found["cmmd"] = cmmd(shown, true)
            found["clip_similarity"] = clip_similarity(shown, true)
        else:
            found[network] = frechet_distance(shown, true)
    return figures
