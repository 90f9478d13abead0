"""A run's page and artifacts, put into a store without running anything."""

import json
import time

from sphere_views import sphere_views, with_a_pattern_in_colour
from textured_sphere import sphere_asset

from flows.config import PipelineConfig
from flows.processes import Process
from flows.run_records import (
    COMPUTED,
    COMPUTING,
    DONE,
    FAILED,
    WAITING,
    RunIndex,
    RunRecord,
    StageRecord,
)
from stages.keys import Recipe
from stages.store import Store

VIEWS = 8
METRICS = {
    "radiance_psnr_db": 24.0,
    "basecolor_psnr_db": 19.5,
    "roughness_psnr_db": 30.0,
    "metallic_psnr_db": 31.0,
    "normal_angle_deg": 4.0,
    "mask_iou": 0.97,
}
CHOICES = {
    "choices": [
        {"setting": "nerf.image_size", "value": 96, "because": "maps can be averaged over 2 px"}
    ],
    "evidence": {},
}
ODD = "a <b>view</b> & the others"  # what no page may take for markup
ERROR = "DivergenceError: nerf: more than 20 steps had a non-finite radiance"


def rows(steps=40):
    """Scalars of a stage: one loss that falls, one that stays."""
    lines = [f"{s},photometric,{1.0 / s:.6g}\n{s},still,2\n" for s in range(1, steps + 1)]
    return "".join(lines)


class MadeRun:
    """Publishes artifacts and writes the page of a run.

    Args:
        root: folder for store and run folder.
        name: of the run folder.
    """

    def __init__(self, root, name="ball"):
        self.store = Store(root / "store")
        self.folder = root / "out" / name
        self.folder.mkdir(parents=True)
        self.source = root / f"{name}.json"
        self.source.write_text("{}")
        self.config = PipelineConfig()
        self.stages = {}

    def publish(self, stage, save, *, events=(), scalars="", config=None):
        """An artifact whose files `save(folder)` writes."""

        def compute(payload, work):
            save(payload)
            if scalars:
                (work / "scalars.csv").write_text(scalars)
            return {
                "seconds": 2.0,
                "cpu_seconds": 3.0,
                "peak_memory_mib": {"host": 321.0},
                "headline": f"{stage} made",
                "events": [{"kind": k, "message": m} for k, m in events],
                "device": "cpu",
                "cores": 2,
                "platform": "Linux",
                "python": "3.11.1",
                "torch": "2.6.0",
                "git_commit": "0123456789abcdef",
            }

        settings = getattr(self.config, stage).model_dump(mode="json") | (config or {})
        inputs = {"source": "5" * 64} if stage == "generation" else {}
        recipe = Recipe(stage, settings, 7, inputs, {}, {"torch": "2.6.0"})
        stored = self.store.obtain(recipe, compute)
        self.stages[stage] = StageRecord(recipe.key, COMPUTED, 2.0, tuple(m for _, m in events))
        return stored

    def views(self, **more):
        views = sphere_views(with_a_pattern_in_colour, views=VIEWS, size=32)
        self.publish("generation", views.save, **more)

    def nerf(self, **more):
        def save(payload):
            (payload / "field.json").write_text("{}")

        events = [("view_outvoted", ODD), ("capacity", "image_size 96 of 128: because")]
        self.publish("nerf", save, events=events, scalars=rows(), config={"steps": 40}, **more)

    def rest(self, asset=None):
        """All that a finished run has besides."""

        def save_json(name, value):
            return lambda payload: (payload / name).write_text(json.dumps(value))

        asset = asset or sphere_asset()
        summary = {"faces": 4096, "texture_size": 64, "glb_bytes": len(asset.files["asset.glb"])}
        whole = asset.__class__(asset.files, summary)
        self.publish("capacity", save_json("capacity.json", CHOICES))
        self.stages["dmtet"] = StageRecord(None, "skipped")
        self.publish("export", whole.save)
        self.publish("preview", save_json("metrics.json", METRICS))

    def failed_in(self, stage):
        """A stage that told something, counted some steps, and failed."""
        recipe = Recipe(stage, {}, 7, {"failed": "yes"}, {}, {})
        work = self.store.work(recipe.key)
        work.mkdir(parents=True)
        (work / "scalars.csv").write_text(rows(12) + "13,photo")
        event = {"kind": "non_finite_step", "message": "step 3 skipped: non-finite radiance"}
        (work / "events.jsonl").write_text(f"\n{json.dumps(event)}\n\n{{cut")
        self.stages[stage] = StageRecord(recipe.key, FAILED, None, (ERROR,))

    def record(self, state=DONE, stage="preview", error="", **more):
        """Write the run's page, and its log where it failed."""
        started = 1_750_000_000.0
        record = RunRecord(
            id=f"{self.folder.name}-12345678",
            command=("run", str(self.source), "--preset", "preview"),
            cwd=str(self.folder),
            pipeline="image-to-asset",
            source=str(self.source),
            preset="preview",
            folder=str(self.folder),
            process=Process.this(),
            state=state,
            stages=self.stages,
            stage=stage,
            step=0,
            total=0,
            started=started,
            changed=started + 100.0,
            ended=started + 100.0,
            error=error,
            **more,
        )
        index = RunIndex(self.store.root)
        index.write(record)
        index.log(record.id).write_text(f"line one\n{error}\n")
        return record


def finished_run(root, name="ball", asset=None):
    made = MadeRun(root, name)
    made.views()
    made.nerf()
    made.rest(asset)
    return made, made.record()


def failed_run(root):
    made = MadeRun(root, "broken")
    made.views()
    made.failed_in("nerf")
    made.stages["export"] = StageRecord("e" * 64, WAITING)
    return made, made.record(FAILED, "nerf", ERROR)


def running_run(root):
    """A run at work: it has views alone."""
    made = MadeRun(root, "busy")
    made.views()
    made.stages["nerf"] = StageRecord("a" * 64, COMPUTING)
    record = made.record("running", "nerf")
    return made, record, time.time()
