"""How well two surfaces agree: Chamfer distance, F-score, consistency of normals.

Samples of one surface are measured to the triangles of the other, so that equal surfaces score
zero; benchmarks that compare samples to samples have a floor of about half the samples' spacing.
Sources: Knapitsch et al. 2017, "Tanks and Temples", section 4 (F-score); Mescheder et al. 2019,
"Occupancy Networks", supplementary, section 1.3 (normal consistency).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from svim3d.metrics.surface_search import nearest_face, sample_faces
from svim3d.numerics import dot

SAMPLES = 100_000  # of each surface
THRESHOLDS = (0.01, 0.02, 0.05, 0.1)  # of the F-score; the truth's longest side is 1

Mesh = tuple[Float[Tensor, "N 3"], Int[Tensor, "F 3"]]


@dataclass(frozen=True)
class FScore:
    """Shares of both surfaces that lie near the other one.

    Attributes:
        precision: of the prediction, within the threshold of the truth.
        recall: of the truth, within the threshold of the prediction.
        f: their harmonic mean, 0 if both are.
    """

    precision: float
    recall: float
    f: float


@dataclass(frozen=True)
class SurfaceAgreement:
    """All figures of a pair of surfaces, in the meshes' unit of length.

    Attributes:
        accuracy: mean distance from the prediction to the truth.
        completeness: mean distance from the truth to the prediction.
        chamfer: mean of these two. Some papers take their sum, which is twice as much.
        chamfer_squared: mean of both mean SQUARED distances, in the unit's square.
        f_scores: by threshold.
        normal_consistency: mean |cos| between normals of a sample and of the face nearest to it,
            mean of both ways; 1 is best, 0.5 is chance. It does not see inverted surfaces.
    """

    accuracy: float
    completeness: float
    chamfer: float
    chamfer_squared: float
    f_scores: Mapping[float, FScore]
    normal_consistency: float


def compare_surfaces(
    prediction: Mesh,
    truth: Mesh,
    generator: torch.Generator,
    *,
    samples: int = SAMPLES,
    thresholds: Sequence[float] = THRESHOLDS,
) -> SurfaceAgreement:
    """Sample both surfaces uniformly by area and measure each to the other's triangles.

    Args:
        prediction: vertices and faces.
        truth: the same.
        generator: of the samples.
        samples: of each surface.
        thresholds: of the F-score.
    """
    to_truth, cosines_a = _measure(prediction, truth, samples, generator)
    to_prediction, cosines_b = _measure(truth, prediction, samples, generator)
    accuracy, completeness = float(to_truth.mean()), float(to_prediction.mean())
    squares = [float(d.square().mean()) for d in (to_truth, to_prediction)]
    return SurfaceAgreement(
        accuracy,
        completeness,
        0.5 * (accuracy + completeness),
        0.5 * sum(squares),
        {t: f_score(to_truth, to_prediction, t) for t in thresholds},
        0.5 * float(cosines_a.mean() + cosines_b.mean()),
    )


def f_score(
    to_truth: Float[Tensor, "P"], to_prediction: Float[Tensor, "Q"], threshold: float
) -> FScore:
    """From the distances of either side's samples to the other side.

    Args:
        to_truth: of samples of the prediction.
        to_prediction: of samples of the truth.
        threshold: distance that still counts as near.
    """
    precision, recall = (float((d <= threshold).double().mean()) for d in (to_truth, to_prediction))
    both = precision + recall
    return FScore(precision, recall, 2.0 * precision * recall / both if both > 0.0 else 0.0)


def squared_chamfer(points: Float[Tensor, "P 3"], truth: Float[Tensor, "Q 3"]) -> float:
    """Mean of both mean squared distances between two sets of points; equal sets give zero."""
    a, b = (p.detach().cpu().double().numpy() for p in (points, truth))
    ways = [cKDTree(other).query(own)[0] for own, other in ((a, b), (b, a))]
    return 0.5 * float(sum((distance**2).mean() for distance in ways))


def _measure(
    mesh: Mesh, other: Mesh, samples: int, generator: torch.Generator
) -> tuple[Float[Tensor, "P"], Float[Tensor, "P"]]:
    """Distances from samples of a mesh to another one, and |cos| of the normals there."""
    points, face = sample_faces(*mesh, samples, generator)
    distance, nearest = nearest_face(points.double(), *other)
    cosine = dot(_face_normals(*mesh)[face], _face_normals(*other)[nearest.cpu()])
    return distance, cosine.abs()[:, 0]


def _face_normals(
    vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "F 3"]:
    """Unit, zero for faces without an area."""
    corners = vertices.detach().cpu().double()[faces.cpu().long()]
    # Small faces of large meshes have areas whose squares vanish beside a guarded length's floor.
    edges = (corners[:, i] - corners[:, 0] for i in (1, 2))
    return torch.nn.functional.normalize(torch.linalg.cross(*edges), dim=-1, eps=1e-30)
