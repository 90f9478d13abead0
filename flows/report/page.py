"""The page of a run, put together of what is known of it; nothing is computed."""

import base64
import json
import math
import shlex
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from markupsafe import Markup

from flows.report.charts import sparkline
from flows.report.evidence import RunEvidence, StageEvidence
from flows.report.notes import CAPACITY, WITHOUT, grouped, remedy
from flows.report.pictures import Pictures
from flows.report.template import TEMPLATES, filled
from flows.run_records import CACHED, COMPUTED, DIED, DONE, FAILED
from stages.preview_bounds import LEAST_DB, LEAST_OVERLAP, MOST_ANGLE_DEG

VENDOR = Path(__file__).parent / "vendor" / "model-viewer" / "model-viewer.min.js"
MODEL, POSTER, ASSET = "model.glb", "poster.webp", "asset.glb"
SUMMARY, METRICS, PLAN = "summary.json", "metrics.json", "capacity.json"
CHANNELS = ("rgb", "basecolor", "roughness", "metallic", "normal", "mask", "confidence")
LABELS = {"rgb": "RGB"}
LIGHT_LABELS = {"found": "as found"}
MOST_CURVES = 18  # of a stage
NOT_FITTED = ("generation",)  # what it counts on its way is no loss
LEAST_TOLD_S = 0.1
MOST_INPUT_BYTES = 1 << 20  # of a photo that goes into the page as it is
MIME = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".webp": "image/webp"}
FIGURES = {
    "radiance_psnr_db": ("radiance", "dB", "the picture as displayed, light and all"),
    "basecolor_psnr_db": ("basecolor", "dB", "the colour of the material"),
    "roughness_psnr_db": ("roughness", "dB", "how matt it is"),
    "metallic_psnr_db": ("metallic", "dB", "where it is metal"),
    "normal_angle_deg": ("normals", "degrees", "how far the surface leans the wrong way"),
    "mask_iou": ("outlines", "", "how much of both outlines overlaps"),
}


def run_page(evidence: RunEvidence, pictures: Pictures) -> str:
    """The whole page, as HTML."""
    record = evidence.record
    state = record.now
    model, model_note = _model(evidence, pictures)
    channels = _channels(pictures)
    values: dict[str, Any] = {
        "title": f"{record.asset}: report",
        "run": {
            "name": record.asset,
            "state": state,
            "failed": state != DONE,
            "fault_title": _fault_title(evidence),
            "error": record.error,
            "remedy": _remedy(evidence),
            "resume": f"svim3d resume {record.id}" if record.command else "",
            "log": evidence.log,
        },
        "facts": _facts(evidence),
        "notes": list(grouped(_events(evidence, pictures)).items()),
        "skipped": _left_out(evidence),
        "inputs": _inputs(evidence, pictures),
        "channels": channels,
        "has_asset": any(channel["asset"] for channel in channels),
        "views": pictures.about.get("views", []),
        "figures": _figures(evidence),
        "losses": [
            found
            for stage in evidence.stages
            if stage.name not in NOT_FITTED and (found := _losses(stage))
        ],
        "stages": _stages(evidence.stages),
        "cost_note": _cost_note(evidence, pictures),
        "capacity": _capacity(evidence),
        "made": _made(evidence),
        "command": f"svim3d {shlex.join(record.command)}" if record.command else "",
        "settings": evidence.settings(),
        "versions": _versions(evidence),
        "keys": "\n".join(f"{s.name:12} {s.key}" for s in evidence.stages if s.key),
        "model": _safe(base64.b64encode(model).decode()) if model else "",
        "model_note": model_note,
        "poster": _data(pictures.files.get(POSTER), "image/webp"),
        "camera": _camera(pictures),
        "lights": _lights(pictures),
        "about": _about(pictures),
        "model_viewer": _safe(_viewer_code()) if model else "",
        "script": _safe((TEMPLATES / "scrubber.js").read_text()),
        "viewer_script": _safe((TEMPLATES / "viewer.js").read_text()),
        "written": time.strftime("%Y-%m-%d %H:%M:%S %z", time.localtime()),
        "version": _version(),
    }
    return filled("run.html.j2", **values, contents=_contents(values))


def _safe(text: str) -> Markup:
    """Code and data of our own, that goes into the page as it is."""
    return Markup(text.replace("</script", "<\\/script"))


def _data(content: bytes | None, mime: str) -> str:
    """A file as an address that holds it; empty for none."""
    return f"data:{mime};base64,{base64.b64encode(content).decode()}" if content else ""


def _viewer_code() -> str:
    """The vendored viewer; what its last line points to is not shipped."""
    return VENDOR.read_text().partition("\n//# sourceMappingURL")[0]


def _contents(values: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Anchors and names of the sections that are there."""
    sections = (
        ("fault", "What failed", values["run"]["failed"]),
        ("asset", "Asset", values["model"] or values["poster"] or values["model_note"]),
        ("notes", "What to know", values["notes"] or values["skipped"]),
        ("views", "Views", values["inputs"] or values["channels"]),
        ("figures", "Figures", values["figures"]),
        ("losses", "Losses", values["losses"]),
        ("cost", "Time and memory", True),
        ("sizes", "Sizes", values["capacity"]),
        ("made", "How it was made", True),
    )
    return [(anchor, name) for anchor, name, is_there in sections if is_there]


# What failed.


def _fault_title(evidence: RunEvidence) -> str:
    record = evidence.record
    at = f" in stage {record.stage}" if record.stage else ""
    if record.now == FAILED:
        return f"This run failed{at}"
    return f"This run is not finished: {record.now}{at}"


def _remedy(evidence: RunEvidence) -> str:
    record = evidence.record
    if record.error:
        return remedy(record.error)
    if record.now == DIED:
        return (
            "The process went without a word: killed, out of memory, or the power failed. Look at "
            "the machine's own log."
        )
    return "It was stopped, or still runs: write the report again when it is done."


# What came out.


def _facts(evidence: RunEvidence) -> list[dict[str, Any]]:
    """The few figures that are looked at first."""
    facts = []
    metrics, summary = _json(evidence, "preview", METRICS), _json(evidence, "export", SUMMARY)
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


def _json(evidence: RunEvidence, stage: str, name: str) -> dict[str, Any]:
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


def _figures(evidence: RunEvidence) -> list[dict[str, Any]]:
    metrics = _json(evidence, "preview", METRICS)
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


def _model(evidence: RunEvidence, pictures: Pictures) -> tuple[bytes, str]:
    """The asset as the page turns it, and what is to be said of it."""
    stored = evidence.artifacts.get("export")
    told = dict(pictures.events)
    if stored is None or not pictures.files:
        return b"", "" if stored is None else "The asset is in asset.glb, beside this page."
    if "model_left_out" in told:
        return b"", told["model_left_out"]
    note = told.get("model_reduced", "")
    return pictures.files.get(MODEL) or (stored.folder / ASSET).read_bytes(), note


def _camera(pictures: Pictures) -> dict[str, Any]:
    """Where the viewer looks from at first: as the first view does."""
    views = pictures.about.get("views") or [
        {"azimuth_deg": 0.0, "elevation_deg": 10.0, "distance": 2.0, "fov_y_deg": 33.8}
    ]
    first = views[0]
    orbit = f"{first['azimuth_deg']}deg {90 - first['elevation_deg']:g}deg {first['distance']}m"
    return {"orbit": orbit, "fov": first["fov_y_deg"]}


def _lights(pictures: Pictures) -> list[dict[str, Any]]:
    return [
        {
            "name": name,
            "label": LIGHT_LABELS.get(name, name),
            "data": _safe(base64.b64encode(pictures.files[f"lights/{name}.hdr"]).decode()),
            "picture": _data(pictures.files.get(f"lights/{name}.webp"), "image/webp"),
        }
        for name in pictures.about.get("light", ())
    ]


def _about(pictures: Pictures) -> Markup:
    known = {name: pictures.about.get(name, []) for name in ("views", "columns")}
    return _safe(json.dumps(known))


# What went in.


def _events(evidence: RunEvidence, pictures: Pictures) -> Iterator[tuple[str, str, str]]:
    """Stage, kind and message of what is said nowhere else on the page."""
    has_sizes = bool(_json(evidence, "capacity", PLAN))
    for stage in evidence.stages:
        for kind, message in stage.events:
            if message != evidence.record.error and not (has_sizes and kind == CAPACITY):
                yield stage.name, kind, message
    yield from (("report", kind, message) for kind, message in pictures.events)


def _left_out(evidence: RunEvidence) -> list[tuple[str, str]]:
    """Stages without an artifact, and what that means for the asset."""
    return [
        (s.name, WITHOUT[s.name])
        for s in evidence.stages
        if not s.key and s.name in WITHOUT and s.state == "skipped"
    ]


def _inputs(evidence: RunEvidence, pictures: Pictures) -> list[dict[str, str]]:
    """The photo and what was cut out of it."""
    source = Path(evidence.record.source)
    given = _data(pictures.files.get("input.webp"), "image/webp")
    mime = MIME.get(source.suffix.lower())
    if not given and mime and source.is_file() and source.stat().st_size <= MOST_INPUT_BYTES:
        given = _data(source.read_bytes(), mime)
    cut_out = _data(pictures.files.get("cut_out.webp"), "image/webp")
    found = (
        (given, "The photo as it was given", source.name),
        (cut_out, "The object that was cut out of the photo", "cut out and centred"),
    )
    return [{"data": d, "alt": alt, "caption": caption} for d, alt, caption in found if d]


def _channels(pictures: Pictures) -> list[dict[str, str]]:
    return [
        {
            "name": name,
            "label": LABELS.get(name, name),
            "views": _data(pictures.files.get(f"views/{name}.webp"), "image/webp"),
            "asset": _data(pictures.files.get(f"asset/{name}.webp"), "image/webp"),
        }
        for name in CHANNELS
        if f"views/{name}.webp" in pictures.files
    ]


# How it went.


def _losses(stage: StageEvidence) -> dict[str, Any] | None:
    curves = []
    for term, curve in list(stage.curves.items())[:MOST_CURVES]:
        svg = sparkline(f"{term} over {len(curve)} steps", curve)
        if svg and not _is_flat(curve):
            ends = {"first": f"{curve[0][1]:.3g}", "last": f"{curve[-1][1]:.3g}"}
            curves.append({"name": term.replace("_", " "), "svg": Markup(svg), **ends})
    if not curves:
        return None
    steps = max(curve[-1][0] for curve in stage.curves.values())
    return {"name": stage.name, "about": f"{steps} steps", "curves": curves}


def _is_flat(curve: Iterable[tuple[int, float]]) -> bool:
    """Whether a term says nothing: it never changed."""
    return len({value for _, value in curve if math.isfinite(value)}) < 2


def _stages(stages: Sequence[StageEvidence]) -> list[dict[str, Any]]:
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


def _cost_note(evidence: RunEvidence, pictures: Pictures) -> str:
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


def _capacity(evidence: RunEvidence) -> list[dict[str, Any]]:
    """What the views ask for, beside the settings that bound it."""
    configs = {n: stored.manifest.recipe.config for n, stored in evidence.artifacts.items()}
    rows = []
    for choice in _json(evidence, "capacity", PLAN).get("choices", ()):
        stage, _, name = choice["setting"].partition(".")
        bound = configs.get(stage, {}).get(name, "")
        if isinstance(bound, list) and bound:
            bound = bound[-1]
        enough = choice["value"]
        used = min(enough, bound) if isinstance(bound, int | float) else enough
        said = {"value": f"{enough:g}", "bound": bound, "used": f"{used:g}"}
        rows.append(choice | said)
    return rows


# How it was made.


def _made(evidence: RunEvidence) -> list[tuple[str, str]]:
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


def _versions(evidence: RunEvidence) -> str:
    found: dict[str, str] = {}
    for stored in evidence.artifacts.values():
        found |= stored.manifest.recipe.versions
    return ", ".join(f"{name} {number}" for name, number in sorted(found.items()))


def _version() -> str:
    try:
        return version("svim3d")
    except PackageNotFoundError:
        return "(from a checkout)"
