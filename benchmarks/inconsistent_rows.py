"""The rows of the table of inconsistent views: what each changes in the settings that all share.

A remedy that a row goes without is switched off by its settings here; a row is a list of them. A
setting that the pipeline does not have is an error before anything is run.
"""

from flows.config import PipelineConfig, load_config

PRESET = "standard"

# Whole cases in about a CPU minute on views of 128 x 128, with all phases.
SMALL = (
    "env_preopt.size=64",
    "env_preopt.steps=100",
    "env_preopt.max_pixels=30000",
    "nerf.steps=250",
    "nerf.rays_per_step=2048",
    "nerf.grid_nodes=[48, 64, 96]",
    "nerf.grid_shares=[0.0, 0.4, 0.7]",
    "nerf.hash_log2_entries=15",
    "dmtet.steps=50",
    "dmtet.cells=64",
    "uv_bake.texture_size=512",
    "uv_bake.max_faces=8000",
    "uv_bake.fit_iterations=12",
    "uv_bake.occlusion_rays=32",
)

# 24 white lobes in place of the environment map, as SV3D lights its objects; they stay as phase 0
# left them, because what phases 1 and 2 optimise is a map.
SPHERICAL_GAUSSIANS = (
    "env_preopt.light=spherical_gaussians",
    "nerf.environment_rate=0",
    "dmtet.environment_rate=0",
)
NO_HOMOGRAPHY = ("nerf.warp_start=1", "dmtet.warp_start=1")
LATE_HOMOGRAPHY = ("nerf.warp_start=0.5",)  # the paper's, from the middle of phase 1 on
VIEW_MASKING = ("nerf.facing_gamma=1", "dmtet.facing_gamma=1")

# The paper's ablation, then what is on by default: homographies from a tenth of phase 1 on, views
# weighed by their agreement, no masking by angle; at last what the start from a hull adds, which
# overrules masks in all rows but the last (the paper starts from no hull).
ROWS: dict[str, tuple[str, ...]] = {
    "no remedy": NO_HOMOGRAPHY,
    "without homography": (*NO_HOMOGRAPHY, *VIEW_MASKING),
    "without environment": (*LATE_HOMOGRAPHY, *VIEW_MASKING, *SPHERICAL_GAUSSIANS),
    "without view masking": LATE_HOMOGRAPHY,
    "full, as in the paper": (*LATE_HOMOGRAPHY, *VIEW_MASKING),
    "ours": (),
    "ours, strict hull": ("nerf.hull_rejections=0",),
}


def overrides_of(row: tuple[str, ...], size: int, given: list[str]) -> list[str]:
    """All settings of a case, later ones before earlier ones.

    Raises:
        InputError: there is no such setting, or its value is out of bounds.
    """
    sized = [f"nerf.image_size={size}", f"dmtet.image_size={size}"]
    overrides = [*SMALL, *sized, *given, *row]
    load_config(PipelineConfig, PRESET, overrides)
    return overrides
