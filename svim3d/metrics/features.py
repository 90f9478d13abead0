"""Distances between sets of pictures, by features that a network gives.

Features come as matrices, one row a picture; `efficientnet`, `inception` and the image tower of
CLIP give them. A figure belongs to its network: only features of Inception with the weights of FID
make a Fréchet distance an FID.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

# Source: Jayasumana et al. 2024, "Rethinking FID", section 5, and its public code.
CMMD_SIGMA, CMMD_SCALE = 10.0, 1000.0
CMMD_ROWS = 1024  # of kernel values held at once


def frechet_distance(a: Float[Tensor, "N d"], b: Float[Tensor, "M d"]) -> float:
    """Squared Fréchet distance of the Gaussians with the means and covariances of two sets.

    |mean_a - mean_b|^2 + tr(A + B - 2 (A B)^(1/2)), covariances divided by N - 1. With X the
    centred rows, the last trace is the sum of singular values of X_a X_b^T: no root of a matrix
    is taken, which fails where there are fewer pictures than features. There the figure is biased
    upward, the more the fewer there are: compare sets of equal size.
    Source: Dowson and Landau 1982; Heusel et al. 2017, eq. 6.

    Raises:
        ValueError: a set has fewer than two pictures.
    """
    if min(len(a), len(b)) < 2:
        raise ValueError(f"wanted at least 2 pictures in each set, got {len(a)} and {len(b)}")
    a, b = a.double(), b.double()
    apart = (a.mean(0) - b.mean(0)).square().sum()
    root_a, root_b = _covariance_root(a), _covariance_root(b)
    common = torch.linalg.svdvals(root_a @ root_b.T).sum()
    return float(apart + root_a.square().sum() + root_b.square().sum() - 2.0 * common)


def _covariance_root(features: Float[Tensor, "N d"]) -> Float[Tensor, "K d"]:
    """A matrix R of at most d rows whose R^T R is the covariance."""
    centred = (features - features.mean(0)) / (len(features) - 1) ** 0.5
    if len(centred) <= centred.shape[1]:
        return centred
    return torch.linalg.qr(centred, mode="r").R


def cmmd(a: Float[Tensor, "N d"], b: Float[Tensor, "M d"]) -> float:
    """1000 times the squared maximum mean discrepancy of two sets of CLIP's image embeddings.

    Embeddings are made unit; the kernel is Gaussian with sigma 10. The estimate is the biased one
    of the public code: means run over all pairs, a picture with itself too, so that equal sets
    give 0. Published figures use ViT-L/14 at 336 pixels; another tower has another scale.
    Source: Jayasumana et al. 2024, "Rethinking FID", section 5.
    """
    a, b = normalize(a.double(), dim=-1), normalize(b.double(), dim=-1)
    within = _mean_kernel(a, a) + _mean_kernel(b, b)
    return CMMD_SCALE * (within - 2.0 * _mean_kernel(a, b))


def _mean_kernel(a: Float[Tensor, "N d"], b: Float[Tensor, "M d"]) -> float:
    """Mean of exp(-|x - y|^2 / (2 sigma^2)) over all pairs of unit rows."""
    total = 0.0
    for rows in a.split(CMMD_ROWS):
        squared = 2.0 - 2.0 * rows @ b.T
        total += float((-squared / (2.0 * CMMD_SIGMA**2)).exp().sum())
    return total / (len(a) * len(b))


def clip_similarity(a: Float[Tensor, "N d"], b: Float[Tensor, "N d"]) -> float:
    """CLIP-S: 100 times the mean cosine of pairs of embeddings; 100 is equal.

    Pairs are picture and picture. Unrelated pictures of objects on white score far above zero,
    so that differences count and not the height. Negative cosines are kept.
    Source: Hessel et al. 2021, "CLIPScore", without its factor 2.5 and its clamp.
    """
    return 100.0 * float(
        (normalize(a.double(), dim=-1) * normalize(b.double(), dim=-1)).sum(-1).mean()
    )
