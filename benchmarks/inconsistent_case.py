"""One case of inconsistent views, in a process of its own: all stages, then the figures.

The stages see the corrupted orbit, the figures are taken against the true one. Whatever happens is
written down: an asset and its figures, or the error that was the clear answer instead.
"""

import argparse
import json
import sys
import traceback
from pathlib import Path
from typing import Any

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.pipeline_case import case_key, measure, plan_case  # noqa: E402
from flows.plan import Plan  # noqa: E402
from stages.errors import (  # noqa: E402
    DivergenceError,
    InputError,
    StageTimeoutError,
    TransientError,
)
from stages.settings.evaluation import EvaluationConfig  # noqa: E402
from stages.store import Store  # noqa: E402
from svim3d.io.exr import read_rgb  # noqa: E402
from svim3d.io.glb import read_mesh  # noqa: E402
from svim3d.io.orbit import read_orbit  # noqa: E402
from svim3d.metrics import psnr  # noqa: E402
from svim3d.render.deferred import environment_shader  # noqa: E402
from svim3d.render.pictures import render_pictures  # noqa: E402
from svim3d.shading.environment import octahedral_from_latlong  # noqa: E402
from svim3d.shading.prefilter import PyramidOperator  # noqa: E402
from svim3d.shading.tonemap import agx  # noqa: E402

# These say what was wanted and what to do.
CLEAR = (InputError, DivergenceError, TransientError, StageTimeoutError)


def outcome(plan: Plan, store: Store, truth: Path) -> dict[str, Any]:
    """Figures of the asset, or why there is none."""
    try:
        result = measure(plan, store, truth)
    except CLEAR as error:
        return {"outcome": "refused", "error": f"{type(error).__name__}: {error}"}
    except Exception:
        return {"outcome": "crashed", "error": traceback.format_exc(limit=-3)}
    asset = store.check(case_key(plan)).stored
    assert asset is not None, "it has just been measured"
    result["figures"]["view_db"] = view_db(asset.folder, truth)
    return {"outcome": "asset", **result}


def view_db(asset: Path, truth: Path) -> float:
    """PSNR after AgX of the asset under its own light at the held-out cameras, on the true mask."""
    mesh = read_mesh(asset / "asset.glb")
    latlong = torch.from_numpy(read_rgb(asset / "environment.exr"))
    config = EvaluationConfig()
    light = octahedral_from_latlong(latlong, config.light_size)
    pyramid = PyramidOperator.build(config.light_size)(light)
    cameras, views, _ = read_orbit(truth, "test_A")
    shader = environment_shader(pyramid, multiple_scattering=True)
    shown = render_pictures(mesh, cameras, shader, supersample=config.supersample)["radiance"]
    values = [
        psnr(agx(shown[v]), agx(views["radiance"][v]), views["mask"][v] > 0.5)
        for v in range(len(cameras))
    ]
    return float(np.mean(values))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("orbit", type=Path, help="the corrupted one")
    parser.add_argument("truth", type=Path)
    parser.add_argument("--preset", required=True)
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument("--store", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True, help="JSON file for the result")
    given = parser.parse_args()
    store = Store(given.store)
    plan = plan_case(given.orbit, given.preset, given.overrides, [], store=store, seed=given.seed)
    result = {"key": case_key(plan), **outcome(plan, store, given.truth)}
    given.out.write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
