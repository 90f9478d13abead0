"""What a report lists: figures, losses, time and memory, sizes, how all was made."""

import json
import math
import time
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from flows.report.charts import sparkline
from flows.report.evidence import RunEvidence, StageEvidence
from flows.report.pictures import Pictures
from flows.run_records import CACHED, COMPUTED, FAILED
from stages.preview_bounds import LEAST_DB, LEAST_OVERLAP, MOST_ANGLE_DEG

SUMMARY, METRICS, PLAN = "summary.json", "metrics.json", "capacity.json"
MOST_CURVES = 18  # of a stage
LEAST_TOLD_S = 0.1
FIGURES = {
    "radiance_psnr_db": ("radiance", "dB", "the picture as displayed, light and all"),
    "basecolor_psnr_db": ("basecolor", "dB", "the colour of the material"),
    "roughness_psnr_db": ("roughness", "dB", "how matt it is"),
    "metallic_psnr_db": ("metallic", "dB", "where it is metal"),
    "normal_angle_deg": ("normals", "degrees", "how far the surface leans the wrong way"),
    "mask_iou": ("outlines", "", "how much of both outlines overlaps"),
}


def facts(evidence: RunEvidence) -> list[dict[str, Any]]:
    """The few figures that are looked at first."""
    facts = []
    metrics, summary = json_of(evidence, "preview", METRICS), json_of(evidence, "export", SUMMARY)
    for name in ("basecolor_psnr_db", "normal_angle_deg"):
        if name in metrics:
            label, unit, _ = FIGURES[name]
            facts.append(_fact(label, f"{metrics[name]:.1f}", unit, _is_bad(name, metrics[name])))
    if summary:
        facts.append(_fact("triangles", f"{summary['faces']:,}", ""))
        size = summary.get("texture_size")
        facts.append(_fact("textures", f"{size}" if size else "none", "px" if size else ""))
        facts.append(_fact("asset.glb", f"{summary['glb_bytes'] / 2**20:.1f}", "MiB"))
    facts.append(_fact("time", *_in_words(evidence.record.duration_s)))
    return facts


def _fact(name: str, value: str, unit: str = "", bad: bool = False) -> dict[str, Any]:
    return {"name": name, "value": value, "unit": unit, "bad": bad}


def _in_words(seconds: float) -> tuple[str, str]:
    """A length of time and its unit."""
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f}", unit
    return f"{seconds:.1f}", "s"


def json_of(evidence: RunEvidence, stage: str, name: str) -> dict[str, Any]:
    """A JSON file of a stage's artifact; empty where there is none."""
    stored = evidence.artifacts.get(stage)
    file = stored.folder / name if stored else None
    return dict(json.loads(file.read_text())) if file and file.is_file() else {}


def _bound(name: str) -> float:
    channel = name.removesuffix("_psnr_db")
    return {**LEAST_DB, "normal_angle_deg": MOST_ANGLE_DEG, "mask_iou": LEAST_OVERLAP}[channel]


def _is_bad(name: str, value: float) -> bool:
    is_within = value <= _bound(name) if name == "normal_angle_deg" else value >= _bound(name)
    return not is_within  # which holds for what is no number, too


def figures(evidence: RunEvidence) -> list[dict[str, Any]]:
    """Of the preview stage: value, bound, and whether that is kept."""
    metrics = json_of(evidence, "preview", METRICS)
    rows = []
    for name, (label, unit, means) in FIGURES.items():
        if name in metrics:
            digits = 3 if name == "mask_iou" else 1
            side = "at most" if name == "normal_angle_deg" else "at least"
            rows.append(
                {
                    "name": label,
                    "value": f"{metrics[name]:.{digits}f} {unit}".strip(),
                    "bound": f"{side} {_bound(name):g}",
                    "bad": _is_bad(name, metrics[name]),
                    "means": means,
                }
            )
    return rows


def losses(stage: StageEvidence) -> dict[str, Any] | None:
    """The curves of a stage; None where it counted nothing that changed."""
    curves = []
    for term, curve in list(stage.curves.items())[:MOST_CURVES]:
        svg = sparkline(f"{term} over {len(curve)} steps", curve)
        if svg and not _is_flat(curve):
            ends = {"first": f"{curve[0][1]:.3g}", "last": f"{curve[-1][1]:.3g}"}
            curves.append({"name": term.replace("_", " "), "svg": svg, **ends})
    if not curves:
        return None
    steps = max(curve[-1][0] for curve in stage.curves.values())
    return {"name": stage.name, "about": f"{steps} steps", "curves": curves}


def _is_flat(curve: Iterable[tuple[int, float]]) -> bool:
    """Whether a term says nothing: it never changed."""
    return len({value for _, value in curve if math.isfinite(value)}) < 2


def stage_rows(stages: Sequence[StageEvidence]) -> list[dict[str, Any]]:
    """What each stage took."""
    longest = max((s.seconds or 0.0 for s in stages), default=0.0)
    return [
        {
            "name": s.name,
            "state": "was at work" if s.state == "computing" else s.state,
            "away": not s.stored and s.state != FAILED,
            "bad": s.state == FAILED,
            "cached": s.state == CACHED,
            "share": None if s.seconds is None else round(100 * s.seconds / (longest or 1.0), 1),
            "seconds": "" if s.seconds is None else f"{s.seconds:.1f}",
            "cpu": "" if s.cpu_seconds is None else f"{s.cpu_seconds:.1f}",
            "memory": f"{s.memory_mib:.0f}" if s.memory_mib else "",
            "size": "" if s.size is None else f"{s.size / 2**20:.1f} MiB",
            "headline": s.headline,
        }
        for s in stages
    ]


def cost_note(evidence: RunEvidence, pictures: Pictures) -> str:
    """What the rows do not say of time."""
    parts = []
    if any(stage.state == CACHED for stage in evidence.stages):
        parts.append("Striped: taken from the store; the time is what making it took then.")
    computed = [s.seconds for s in evidence.stages if s.state == COMPUTED and s.seconds]
    if computed:
        parts.append(f"{sum(computed):.1f} s went into stages in this run.")
    waited_s = evidence.about.get("engine_startup_s", 0.0)
    if waited_s >= LEAST_TOLD_S:
        parts.append(f"{waited_s:.1f} s were spent on the engine's start.")
    if pictures.cpu_seconds:
        parts.append(f"The pictures of this page took {pictures.cpu_seconds:.1f} CPU seconds.")
    return " ".join(parts)


def sizes(evidence: RunEvidence) -> list[dict[str, Any]]:
    """What the views ask for, beside the settings that bound it."""
    configs = {n: stored.manifest.recipe.config for n, stored in evidence.artifacts.items()}
    rows = []
    for choice in json_of(evidence, "capacity", PLAN).get("choices", ()):
        stage, _, name = choice["setting"].partition(".")
        bound = configs.get(stage, {}).get(name, "")
        if isinstance(bound, list) and bound:
            bound = bound[-1]
        enough = choice["value"]
        used = min(enough, bound) if isinstance(bound, int | float) else enough
        said = {"value": f"{enough:g}", "bound": bound, "used": f"{used:g}"}
        rows.append(choice | said)
    return rows


def circumstances(evidence: RunEvidence) -> list[tuple[str, str]]:
    """Input, seed, machine, code: names and values."""
    record = evidence.record
    first = next(iter(evidence.artifacts.values()), None)
    made = first.manifest.record if first else {}
    device = next(reversed(evidence.artifacts.values())).manifest.record if first else {}
    commit = str(made.get("git_commit") or "")
    rows = (
        ("input", record.source),
        ("preset", record.preset),
        ("seed", str(first.manifest.recipe.seed) if first else ""),
        ("run", record.id),
        ("started", time.strftime("%Y-%m-%d %H:%M:%S %z", time.localtime(record.started))),
        ("machine", f"{record.process.host}, {made.get('cores', '?')} cores" if made else ""),
        ("device", str(device.get("device", ""))),
        ("platform", str(made.get("platform", ""))),
        ("python, torch", f"{made['python']}, {made['torch']}" if "python" in made else ""),
        ("commit", commit[:12]),
    )
    return [(name, value) for name, value in rows if value]


def versions(evidence: RunEvidence) -> str:
    """Of all libraries that computed, in a line."""
    found: dict[str, str] = {}
    for stored in evidence.artifacts.values():
        found |= stored.manifest.recipe.versions
    return ", ".join(f"{name} {number}" for name, number in sorted(found.items()))


def own_version() -> str:
    """Of this project."""
    try:
        return version("svim3d")
    except PackageNotFoundError:
        return "(from a checkout)"
