"""The pictures of a report: from the store, or drawn now by the gallery stage and kept there."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flows.pipeline import PHOTOS, SOURCE
from stages.keys import SKIPPED_INPUT, Recipe, code_digests, library_versions
from stages.settings.gallery import GalleryConfig
from stages.store import Store, Stored

STAGE, MODULE = "gallery", "stages.gallery"
INPUTS = ("prepare", "generation", "export")  # in the order of the stage's signature
ABOUT = "gallery.json"
SEED = 0  # nothing is drawn by chance


@dataclass(frozen=True)
class Pictures:
    """Files of a gallery.

    Attributes:
        files: by name.
        about: its `gallery.json`.
        events: kind and message of what it had to leave out.
        cpu_seconds: that drawing them took, now or some time ago.
    """

    files: Mapping[str, bytes]
    about: Mapping[str, Any]
    events: tuple[tuple[str, str], ...] = ()
    cpu_seconds: float = 0.0

    @classmethod
    def of(cls, stored: Stored) -> "Pictures":
        """Read an artifact."""
        found = {
            file.relative_to(stored.folder).as_posix(): file.read_bytes()
            for file in sorted(stored.folder.rglob("*"))
            if file.is_file()
        }
        record = stored.manifest.record
        events = tuple((str(e["kind"]), str(e["message"])) for e in record.get("events", ()))
        return cls(found, json.loads(found[ABOUT]), events, record.get("cpu_seconds", 0.0))


NONE = Pictures({}, {})


def obtain_pictures(
    store: Store, artifacts: Mapping[str, Stored], source: Path, config: GalleryConfig
) -> Pictures:
    """The pictures of whatever a run has got.

    Args:
        store: where they are looked for and kept.
        artifacts: by stage, what the run has.
        source: the run's input, if it is still there.
        config: how much they may take.
    """
    digest = _digest_of_source(artifacts)
    photo = source if source.suffix.lower() in PHOTOS and source.is_file() and digest else None
    given: dict[str, Stored | Path | None] = {SOURCE: photo}
    given |= {name: artifacts.get(name) for name in INPUTS}
    if not any(given.values()):
        return NONE
    keys = {
        name: value.key if isinstance(value, Stored) else digest if value else SKIPPED_INPUT
        for name, value in given.items()
    }
    recipe = Recipe(
        stage=STAGE,
        config=config.model_dump(mode="json"),
        seed=SEED,
        inputs={name: key or SKIPPED_INPUT for name, key in keys.items()},
        code=code_digests(MODULE),
        versions=library_versions(),
    )
    stored = store.check(recipe.key).stored
    if stored is None:
        import torch  # a report of pictures that are there is written without it

        from stages.execution import run_stage
        from stages.gallery import GALLERY

        cpu = torch.device("cpu")
        stored = run_stage(store, recipe, GALLERY, given, config=config, device=cpu)
    return Pictures.of(stored)


def _digest_of_source(artifacts: Mapping[str, Stored]) -> str | None:
    """Of the input as the run read it."""
    for stored in artifacts.values():
        if SOURCE in stored.manifest.recipe.inputs:
            return stored.manifest.recipe.inputs[SOURCE]
    return None
