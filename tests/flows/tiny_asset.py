"""The real pipeline with as little work as it can do, and what became of its stages."""

import json
from pathlib import Path

TINY_ASSET = (
    "env_preopt.size=16",
    "env_preopt.steps=4",
    "env_preopt.max_pixels=500",
    "nerf.steps=40",
    "nerf.rays_per_step=512",
    "nerf.grid_nodes=[24, 32]",
    "nerf.grid_shares=[0, 0.5]",
    "nerf.coarse_nodes=[8]",
    "nerf.hash_levels=4",
    "nerf.hash_log2_entries=11",
    "nerf.hash_finest=48",
    "nerf.hidden=16",
    "nerf.environment_size=16",
    "dmtet.steps=2",
    "dmtet.cells=16",
    "uv_bake.texture_size=64",
    "uv_bake.max_faces=400",
    "uv_bake.occlusion_rays=8",
    "uv_bake.fit_iterations=2",
    "preview.views=2",
    "preview.cell=64",
    "preview.supersample=1",
)


def states(out: Path) -> dict[str, str]:
    page = json.loads((out / "run.json").read_text())
    return {name: stage["state"] for name, stage in page["stages"].items()}
