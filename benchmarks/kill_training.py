"""Training and batches that are killed: they go on, and end like those that were let alone."""

import hashlib
import json
import random
from dataclasses import asdict, replace
from pathlib import Path

from kill_case import SETTINGS, Scene, Subject, content_of

from flows.commands import EXAMPLE, input_path
from stages.locks import is_locked
from svim3d.diffusion.model import ModelSpec
from svim3d.io.model_folder import FORMAT, bundled_model, read_spec

VIEWS, SIZE, OBJECTS = 5, 16, 2
TRAINING = (
    "autoencoder.steps=30",
    "autoencoder.batch=4",
    "expectation.steps=20",
    "expectation.batch=2",
    "generator.phase_1_steps=20",
    "generator.phase_2_steps=20",
    "generator.warm_up=5",
    "generator.precision=float32",
)


def tiny_spec() -> ModelSpec:
    """The bundled model's kind with as little of everything as there can be."""
    return replace(
        read_spec(bundled_model()),
        name="tiny",
        image_size=SIZE,
        views=VIEWS,
        latent_scale=1.0,
        autoencoder={"patch": 4, "latent_channels": 2, "hidden": 8, "layers": 1},
        unet={
            "in_channels": 18,
            "out_channels": 8,
            "block_out_channels": [32, 32],
            "num_attention_heads": [2, 2],
            "layers_per_block": 1,
            "cross_attention_dim": 16,
            "addition_time_embed_dim": 8,
            "attention": [True, True],
        },
        image_encoder={
            "hidden_size": 16,
            "intermediate_size": 32,
            "num_hidden_layers": 1,
            "num_attention_heads": 2,
            "projection_dim": 16,
            "image_size": 8,
            "patch_size": 8,
            "hidden_act": "gelu",
        },
        expectation={"width": 16, "layers": 1, "heads": 2, "harmonics": 2},
    )


class Training:
    """A tiny model, examples to train it on, and what an undisturbed training makes of them."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._data = scene.folder / "examples"
        self._spec = scene.folder / "tiny.json"
        self._spec.write_text(json.dumps({"format": FORMAT, **asdict(tiny_spec())}))
        counts = ["--objects", str(OBJECTS), "--views", str(VIEWS), "--size", str(SIZE)]
        made = scene.start_command(["data", "render", str(self._data), *counts], self._data)
        undisturbed = scene.folder / "training-undisturbed"
        for subject in (made, self.start(undisturbed)) if made.end() == 0 else (made,):
            if subject.end() != 0:
                raise RuntimeError(f"the undisturbed training failed: {subject.said()}")
            self.cpu_s = subject.cpu_s
        self._content = training_content(undisturbed)

    def start(self, out: Path) -> Subject:
        """Begin a training, or go on with it."""
        settings = [f"--set={setting}" for setting in TRAINING]
        given = ["train", str(self._data), "-o", str(out), "--model", str(self._spec)]
        return self._scene.start_command([*given, *settings, "--device", "cpu"], out)

    def differences(self, out: Path) -> list[str]:
        """Files that are not as in the undisturbed training."""
        found, wanted = training_content(out), self._content
        return [n for n in sorted({*found, *wanted}) if found.get(n) != wanted.get(n)]


def training_content(out: Path) -> dict[str, str]:
    """Digests of a training's model, losses and latents."""
    files = [*out.glob("model/*"), *out.glob("*/scalars.csv"), *out.glob("latents/*")]
    return {
        str(file.relative_to(out)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files
    }


class Batch:
    """Two inputs that share all but the last stage; the first is the undisturbed run's."""

    def __init__(self, scene: Scene, name: str) -> None:
        self._scene = scene
        self.store = scene.folder / name
        self._out = scene.folder / f"out-{name}"
        source = input_path(scene.source) if scene.source == EXAMPLE else Path(scene.source)
        self._manifest = scene.folder / f"{name}.csv"
        self._manifest.write_text(f"input,name,preview.cell\n{source},a,96\n{source},b,64\n")

    def start(self) -> Subject:
        """Begin the batch, or go on with it."""
        settings = [f"--set={s}" for s in SETTINGS if not s.startswith("preview.cell")]
        given = ["batch", str(self._manifest), "-o", str(self._out), "--device", "cpu"]
        given += ["--store", str(self.store), "--preset", "preview", *settings]
        return self._scene.start_command(given, self.store)

    def until_published(self, subject: Subject, count: int) -> None:
        """Watch until so many artifacts are there."""
        subject.until(lambda _: len(list(self.store.glob("obj/*"))) >= count)

    def end(self) -> list[str]:
        """Let the batch go to its end; tells what is wrong then."""
        subject = self.start()
        code = subject.end()
        wrong = [] if code == 0 else [f"the last batch ended with code {code}: {subject.said()}"]
        wrong += subject.survivors()
        found, wanted = content_of(self.store), self._scene.content
        wrong += [key[:8] for key in wanted if found.get(key) != wanted[key]]
        if {"": "damaged"} in found.values() or len(found) != len(wanted) + 1:
            wrong.append(f"{len(found)} artifacts instead of {len(wanted) + 1} sound ones")
        wrong += [f"{f.name} is locked" for f in self.store.glob("lock/*") if is_locked(f)]
        return wrong


def moments_of(draw: random.Random, cpu_s: float, count: int) -> list[float]:
    """CPU seconds at which to kill, none of them before the command has read its arguments."""
    return [draw.uniform(0.2 * cpu_s, 0.7 * cpu_s) for _ in range(count)]
