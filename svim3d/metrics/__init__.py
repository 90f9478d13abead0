"""Figures of merit of pictures and surfaces.

Named here is what stages and renders compute with, and no more: a stage's key holds the code of
all that this file imports, and a table's figures should make no artifact anew.
"""

from svim3d.metrics.directions import mean_angle_deg
from svim3d.metrics.pictures import psnr, structural_similarity
from svim3d.metrics.surface_search import distance_to_surface, sample_surface
from svim3d.metrics.volumes import occupancy, volume_iou

__all__ = [
    "distance_to_surface",
    "mean_angle_deg",
    "occupancy",
    "psnr",
    "sample_surface",
    "structural_similarity",
    "volume_iou",
]
