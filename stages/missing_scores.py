"""Missing scores: what Stanford-ORB's script tells of a capture that no asset was made of.

Reads the truth; writes `scores.json` with the same figures as `stages.table_scores`, of white
pictures in the place of the asset's.
"""

from pathlib import Path

import torch

from stages.base import Context, Stage
from stages.errors import InputError
from stages.orb_scores import capture_figures, orb_figures
from stages.pair_distance import read_distance
from stages.scores_artifact import ASSET, NOVEL, RELIT, TableScores, ViewScore
from stages.settings.table_scores import TableScoresConfig
from stages.truth import SEEN, read_truth


def run(truth: Path, *, config: TableScoresConfig, ctx: Context) -> TableScores:
    """Score white pictures.

    Raises:
        InputError: the truth cannot be read.
    """
    try:
        known = read_truth(truth)
        learned = read_distance(config.lpips_weights)
        lit: list[tuple[str, str, dict[str, torch.Tensor]]] = []
        if known.novel is not None:
            lit.append((NOVEL, SEEN, known.novel[1]))
        lit += [(RELIT, name, g.images) for name, gs in known.relit.items() for g in gs]
        views = []
        for part, light, images in lit:
            for view in range(len(images["mask"])):
                true = {name: image[view] for name, image in images.items()}
                figures = orb_figures(part, None, true, learned=learned)
                views.append(ViewScore(part, ASSET, light, 0.0, figures))
        capture = capture_figures(None, None, known, ctx.generator("surfaces"))
    except ValueError as error:
        raise InputError(f"{truth.name}: {error}") from error
    return TableScores(views, {}, {}, 1.0, capture)


MISSING_SCORES = Stage(run)
