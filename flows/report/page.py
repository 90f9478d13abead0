"""The page of a run, put together of what is known of it; nothing is computed."""

import base64
import json
import shlex
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from flows.plan import Verdict
from flows.report.evidence import RunEvidence
from flows.report.notes import CAPACITY, WITHOUT, grouped, remedy
from flows.report.pictures import Pictures
from flows.report.tables import (
    PLAN,
    circumstances,
    cost_note,
    facts,
    figures,
    json_of,
    losses,
    own_version,
    sizes,
    stage_rows,
    versions,
)
from flows.report.template import TEMPLATES, address, filled
from flows.run_records import DIED, DONE, FAILED

VENDOR = Path(__file__).parent / "vendor" / "model-viewer" / "model-viewer.min.js"
MODEL, POSTER, ASSET = "model.glb", "poster.webp", "asset.glb"
CHANNELS = ("rgb", "basecolor", "roughness", "metallic", "normal", "mask", "confidence")
LABELS = {"rgb": "RGB"}
LIGHT_LABELS = {"found": "as found"}
NOT_FITTED = ("generation",)  # what it counts on its way is no loss
MOST_INPUT_BYTES = 1 << 20  # of a photo that goes into the page as it is
MIME = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".webp": "image/webp"}


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
        "facts": facts(evidence),
        "notes": list(grouped(_events(evidence, pictures)).items()),
        "skipped": _left_out(evidence),
        "inputs": _inputs(evidence, pictures),
        "channels": channels,
        "has_asset": any(channel["asset"] for channel in channels),
        "views": pictures.about.get("views", []),
        "figures": figures(evidence),
        "losses": [
            found
            for stage in evidence.stages
            if stage.name not in NOT_FITTED and (found := losses(stage))
        ],
        "stages": stage_rows(evidence.stages),
        "cost_note": cost_note(evidence, pictures),
        "capacity": sizes(evidence),
        "made": circumstances(evidence),
        "command": f"svim3d {shlex.join(record.command)}" if record.command else "",
        "settings": evidence.settings(),
        "versions": versions(evidence),
        "keys": "\n".join(f"{s.name:12} {s.key}" for s in evidence.stages if s.key),
        "model": _safe(base64.b64encode(model).decode()) if model else "",
        "model_note": model_note,
        "poster": address(pictures.files.get(POSTER), "image/webp"),
        "camera": _camera(pictures),
        "lights": _lights(pictures),
        "about": _about(pictures),
        "model_viewer": _safe(_viewer_code()) if model else "",
        "script": _safe((TEMPLATES / "scrubber.js").read_text()),
        "viewer_script": _safe((TEMPLATES / "viewer.js").read_text()),
        "written": time.strftime("%Y-%m-%d %H:%M:%S %z", time.localtime()),
        "version": own_version(),
    }
    return filled("run.html.j2", **values, contents=_contents(values))


def _safe(text: str) -> str:
    """Code and data that a script element holds as they are."""
    return text.replace("</script", "<\\/script")


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
            "picture": address(pictures.files.get(f"lights/{name}.webp"), "image/webp"),
        }
        for name in pictures.about.get("light", ())
    ]


def _about(pictures: Pictures) -> str:
    known = {name: pictures.about.get(name, []) for name in ("views", "columns")}
    return _safe(json.dumps(known))


# What went in.


def _events(evidence: RunEvidence, pictures: Pictures) -> Iterator[tuple[str, str, str]]:
    """Stage, kind and message of what is said nowhere else on the page."""
    has_sizes = bool(json_of(evidence, "capacity", PLAN))
    for stage in evidence.stages:
        for kind, message in stage.events:
            if message != evidence.record.error and not (has_sizes and kind == CAPACITY):
                yield stage.name, kind, message
    yield from (("report", kind, message) for kind, message in pictures.events)


def _left_out(evidence: RunEvidence) -> list[tuple[str, str]]:
    """Stages without an artifact, and what that means for the asset."""
    left_out = [
        (s.name, WITHOUT[s.name])
        for s in evidence.stages
        if not s.key and s.name in WITHOUT and s.state == "skipped"
    ]
    unasked = [s.name for s in evidence.stages if s.state == Verdict.NOT_ASKED]
    if unasked:
        left_out.append((", ".join(unasked), "not asked for: the run was to end before"))
    return left_out


def _inputs(evidence: RunEvidence, pictures: Pictures) -> list[dict[str, str]]:
    """The photo and what was cut out of it."""
    source = Path(evidence.record.source)
    given = address(pictures.files.get("input.webp"), "image/webp")
    mime = MIME.get(source.suffix.lower())
    if not given and mime and source.is_file() and source.stat().st_size <= MOST_INPUT_BYTES:
        given = address(source.read_bytes(), mime)
    cut_out = address(pictures.files.get("cut_out.webp"), "image/webp")
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
            "views": address(pictures.files.get(f"views/{name}.webp"), "image/webp"),
            "asset": address(pictures.files.get(f"asset/{name}.webp"), "image/webp"),
        }
        for name in CHANNELS
        if f"views/{name}.webp" in pictures.files
    ]
