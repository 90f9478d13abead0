"""A training run's folder: what it is made of, and how it goes on.

settings.json      settings, model and data that the run was begun with
autoencoder/       checkpoint and losses; sheet.png
look/              losses, of a model that has one
latents/           a clip file per example
expectation/       checkpoint and losses, of a model that has one
generator/         checkpoint and losses; sheet-<steps>.png
model/             a complete model folder, of the last checkpoint
"""

import hashlib
import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from stages.base import Context, Progress
from stages.errors import InputError
from stages.settings.training import TrainingConfig
from svim3d.diffusion.groups import GROUPS
from svim3d.diffusion.model import MaterialDiffusion, ModelSpec
from svim3d.io.model_folder import CARD, DESCRIPTION, read_model, read_spec, write_model

SETTINGS, MODEL, ORIGIN, NOTICE = "settings.json", "model", "origin.md", "NOTICE"
LOOK, DONE = "look", "done"
EXAMPLES = "*.safetensors"
# Settings that may change when a run goes on: they say how long and how often, not how.
FREE = {
    ("generator", "phase_1_steps"),
    ("generator", "phase_2_steps"),
    ("generator", "checkpoint_every_s"),
    ("generator", "sheet_every_s"),
    ("autoencoder", "steps"),
}


class TrainingFolder:
    """Where a training run keeps everything.

    Args:
        root: the folder.
        seed: of all random numbers.
        device: where to train.
        on_progress: told of every step.
    """

    def __init__(
        self,
        root: Path,
        seed: int,
        device: torch.device,
        on_progress: Callable[[Progress], None] | None = None,
    ) -> None:
        self.root = root
        self.seed = seed
        self.device = device
        self._on_progress = on_progress

    @property
    def model_folder(self) -> Path:
        """The model as of the last checkpoint."""
        return self.root / MODEL

    def context(self, part: str, checkpoint_every_s: float) -> Context:
        """Surroundings of one part of the training."""
        return Context(
            stage=f"training {part}",
            device=self.device,
            seed=self.seed,
            work=self.root / part,
            shared=self.root / "shared",
            on_progress=self._on_progress,
            checkpoint_every_s=checkpoint_every_s,
        )

    def require_same(self, config: TrainingConfig, spec: ModelSpec, first_example: Path) -> None:
        """Hold a run to what it was begun with; write that down at the beginning.

        Raises:
            InputError: something else than the number of steps or of examples has changed.
        """
        file = self.root / SETTINGS
        about = {
            "config": config.model_dump(),
            "model": asdict(spec),
            "seed": self.seed,
            "first_example": hashlib.sha256(first_example.read_bytes()).hexdigest(),
        }
        now = json.loads(json.dumps(about))
        begun = json.loads(file.read_text()) if file.exists() else now
        if changed := sorted(_changes(begun, now)):
            raise InputError(
                f"{self.root} was begun with other settings ({', '.join(changed[:5])}); "
                "use the old ones, or train in another folder"
            )
        if not file.exists():
            self.root.mkdir(parents=True, exist_ok=True)
            temporary = file.with_suffix(".tmp")
            temporary.write_text(json.dumps(now, indent=1) + "\n")
            temporary.replace(file)

    @property
    def has_autoencoder(self) -> bool:
        """Whether the autoencoder is done: a model is written once it is."""
        return (self.model_folder / DESCRIPTION).exists()

    @property
    def has_look(self) -> bool:
        """Whether this run has trained the look."""
        return (self.root / LOOK / DONE).exists()

    def mark_look(self) -> None:
        """The model that is kept holds the look that this run has trained."""
        (self.root / LOOK / DONE).touch()

    def start_model(self, spec: ModelSpec, source: Path) -> MaterialDiffusion:
        """The last checkpoint's weights; or the source's, if it has any; or random ones."""
        if self.has_autoencoder:
            return self.reread_model()
        if source.is_dir():
            self._keep_origin(source)
            self.keep_model(read_model(source, self.device))
            return self.reread_model()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            model = MaterialDiffusion.untrained(spec)
        for part in model.parts.values():
            part.to(self.device)
        return model

    def reread_model(self) -> MaterialDiffusion:
        """As it is kept, rounded: a run that went on sees the same as one that never stopped."""
        return read_model(self.model_folder, self.device)

    def keep_model(self, model: MaterialDiffusion, steps: int = 0) -> None:
        """Write the model folder anew, one file after the other."""
        card = (
            f"# {model.spec.name}\n\nA checkpoint of a training run after {steps} steps of the "
            "generator. Nobody has judged it yet.\n"
        )
        origin = self.root / ORIGIN
        if origin.exists():
            card += (
                f"\nTrained on from this model, whose terms it inherits:\n\n{origin.read_text()}"
            )
        write_model(self.model_folder, model, card)

    def _keep_origin(self, source: Path) -> None:
        """The card and the notice of the model that training goes on from."""
        self.model_folder.mkdir(parents=True, exist_ok=True)
        for name, target in ((CARD, self.root / ORIGIN), (NOTICE, self.model_folder / NOTICE)):
            if (source / name).is_file():
                shutil.copyfile(source / name, target)


def examples_of(data: Path) -> list[Path]:
    """Files of rendered examples, in order.

    Raises:
        InputError: there are none.
    """
    found = sorted(data.glob(EXAMPLES)) if data.is_dir() else []
    if not found:
        raise InputError(
            f"wanted a folder of rendered examples, {data} holds none; "
            "make some with svim3d data render"
        )
    return found


def load_model_spec(file: Path) -> ModelSpec:
    """What to train: a model folder, or a `model.json` alone.

    Raises:
        InputError: it is neither.
    """
    try:
        spec = read_spec(file) if file.is_dir() else read_spec(file.parent, file.name)
    except ValueError as error:
        raise InputError(str(error)) from error
    if spec.groups != GROUPS:
        raise InputError(
            f"wanted a model of the groups {', '.join(GROUPS)}, {file} has "
            f"{', '.join(spec.groups)}; convert it with --groups 4"
        )
    return spec


def _changes(old: Mapping[str, Any], new: Mapping[str, Any], path: Sequence[str] = ()) -> list[str]:
    """Dotted names that differ and may not."""
    changed = []
    for name in {*old, *new}:
        here = (*path, name)
        one, two = old.get(name), new.get(name)
        if isinstance(one, Mapping) and isinstance(two, Mapping):
            changed += _changes(one, two, here)
        elif one != two and here[1:] not in FREE:
            changed.append(".".join(here))
    return changed
