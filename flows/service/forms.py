"""What callers may send and what they get: the models behind the OpenAPI document."""

import json
from typing import Any, Literal

from fastapi import UploadFile
from pydantic import BaseModel, ConfigDict, Field

from flows.service.outcome import Progress
from flows.service.records import ID_PATTERN, Event, Record, State

Preset = Literal["preview", "standard", "paper", "auto"]
Skippable = Literal["capacity", "env_preopt", "dmtet", "uv_bake", "preview"]
# What a form field stands for among all settings; see `svim3d run --help`, `--set`.
SETTING_OF = {
    "samples": "generation.samples",
    "elevation_deg": "generation.elevation_deg",
    "matting": "prepare.matting",
    "fill": "prepare.fill",
    "texture_size": "uv_bake.texture_size",
    "max_faces": "uv_bake.max_faces",
}
MAX_SEED = 2**31 - 1


def _as_sent(schema: dict[str, Any]) -> None:
    """Let the document say what a form can: a field is there or not, but never null."""
    for field in schema["properties"].values():
        variants = field.pop("anyOf", None)
        if variants is not None:
            field |= next(variant for variant in variants if variant["type"] != "null")
        if field.get("default", ...) is None:
            del field["default"]
    schema["oneOf"] = [{"required": ["picture"]}, {"required": ["views"]}]


class JobForm(BaseModel):
    """A picture or views, and a few settings. What is left out is the preset's."""

    model_config = ConfigDict(extra="forbid", json_schema_extra=_as_sent)

    picture: UploadFile | None = Field(
        None, description="a photo of one object: PNG, JPEG, WebP, TIFF, BMP or GIF"
    )
    views: UploadFile | None = Field(
        None,
        description="instead of a picture: a .zip of an orbit folder (orbit.json and an OpenEXR "
        "file per view)",
    )
    preset: Preset = Field("standard", description="from quick to thorough", examples=["preview"])
    seed: int = Field(0, ge=0, le=MAX_SEED, description="of all random numbers")
    samples: int | None = Field(
        None, ge=1, le=4, description="orbits drawn, of which the most agreed-on one is kept"
    )
    elevation_deg: float | None = Field(
        None, gt=-60.0, lt=89.0, description="elevation of the photo's camera"
    )
    matting: Literal["auto", "alpha", "plain"] | None = Field(
        None, description="what cuts the object out: the file's transparency, a plain background"
    )
    fill: float | None = Field(
        None, ge=0.2, le=1.0, description="share of the square that the object's longer side takes"
    )
    texture_size: int | None = Field(None, ge=64, le=4096, description="texels per side")
    max_faces: int | None = Field(None, ge=100, le=100_000, description="of the mesh")
    skip: list[Skippable] = Field(
        default_factory=list, max_length=5, description="stages to leave out"
    )

    def settings(self) -> dict[str, Any]:
        """What was asked for, other than the input."""
        given = self.model_dump(exclude={"picture", "views"}, exclude_none=True)
        return given | {"skip": sorted(set(self.skip))}

    def overrides(self) -> tuple[str, ...]:
        """The same as `--set` wants it; JSON is YAML, and these values are checked ones."""
        given = self.settings()
        return tuple(
            f"{name}={json.dumps(given[field])}"
            for field, name in SETTING_OF.items()
            if field in given
        )


class ProgressView(BaseModel):
    """How far a running job is."""

    stage: str | None = Field(description="at work now; null between two", examples=["nerf"])
    step: int | None = Field(description="of that stage, where it is known")
    total: int | None = Field(description="steps of that stage, where they are known")
    finished: dict[str, str] = Field(
        description="what each finished stage has made, in a line",
        examples=[{"prepare": "2.1 s, square of 576 px, object by its alpha"}],
    )
    notes: list[str] = Field(description="fallbacks that stages took, views they dropped")

    @classmethod
    def of(cls, progress: Progress) -> "ProgressView":
        """The view of a run's progress."""
        return cls(**vars(progress))


class JobView(BaseModel):
    """A job as it stands."""

    id: str = Field(pattern=ID_PATTERN, examples=["0f6f2d3c9a1b4e5f8a7b6c5d4e3f2a1b"])
    state: State = Field(
        description="`queued`, `running`, `cancelling` pass; `done`, `failed`, `cancelled` stay"
    )
    position: int | None = Field(description="jobs before it, while it is queued")
    input: Literal["picture", "views"]
    settings: dict[str, Any] = Field(description="what was asked for")
    created: float = Field(description="seconds since 1970")
    started: float | None = Field(description="of the last run; seconds since 1970")
    finished: float | None = Field(description="seconds since 1970")
    progress: ProgressView | None = Field(description="null before the first run")
    events: list[Event] = Field(description="what happened to the job, the oldest first")
    error: str | None = Field(description="how it failed, in a line")
    files: list[str] = Field(
        description="paths of what can be fetched", examples=[["/jobs/0f6f.../asset.glb"]]
    )

    @classmethod
    def of(
        cls, record: Record, *, position: int | None, progress: Progress | None, files: list[str]
    ) -> "JobView":
        """The view of a record."""
        return cls(
            **record.model_dump(
                include={"id", "state", "settings", "created", "started", "finished", "events"}
            ),
            position=position,
            input="views" if record.input == "views" else "picture",
            progress=progress and ProgressView.of(progress),
            error=record.error,
            files=files,
        )


class JobPage(BaseModel):
    """Some of the jobs, the newest first."""

    jobs: list[JobView]
    total: int = Field(description="jobs in all")
    next: int | None = Field(description="`offset` of the next page; null on the last")


class HealthView(BaseModel):
    """State of the service."""

    status: Literal["ok"] = "ok"
    version: str
    queued: int = Field(description="jobs that wait")
    running: int = Field(description="jobs at work")
    slots: int = Field(description="jobs that may be at work at a time")
    queue: int = Field(description="jobs that may wait")


class Report(BaseModel):
    """What a run did: `run.json` of its folder, without paths of the machine."""

    model_config = ConfigDict(extra="allow")

    stages: dict[str, Any] = Field(description="of each stage state, seconds, result and events")
    config: dict[str, Any] = Field(description="all settings")
