"""`svim3d train`: rendered examples in, a model folder out; goes on where it was stopped.

Autoencoder, latents, generator: each part keeps its state in the run's folder, and what is done is
not done again. `--minutes` cuts a long training into pieces that end like one.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import yaml
from rich.console import Console

from flows.config import validated
from flows.job import DONE, interrupt_on_stop
from stages.errors import InputError
from stages.settings.training import TrainingConfig

if TYPE_CHECKING:
    from stages.base import Progress
    from stages.training_folder import TrainingFolder
    from svim3d.diffusion.model import MaterialDiffusion

TELL_EVERY_S = 30.0
SHOWN_CLIPS = (0, 1)


def train(options: argparse.Namespace) -> int:
    """Train what the command line names; see `svim3d train --help`."""
    config = load_training_config(options.config, options.set)
    from stages.execution import choose_device
    from stages.training_folder import TrainingFolder, examples_of, load_model_spec

    examples = examples_of(options.data)
    spec = load_model_spec(options.model)
    console = Console()
    folder = TrainingFolder(
        options.output, options.seed, choose_device(options.device), _Teller(console)
    )
    folder.require_same(config, spec, options.data)
    interrupt_on_stop()
    model = folder.start_model(spec, options.model)
    model = _with_autoencoder(folder, model, examples, config)
    _train_generator(folder, model, examples, config, options.minutes)
    console.print(f"{folder.model_folder}: a model for svim3d run --model", highlight=False)
    return DONE


def load_training_config(file: Path | None, overrides: Sequence[str]) -> TrainingConfig:
    """Settings from a YAML file, then from `part.name=value`.

    Raises:
        InputError: the file cannot be read, or a name or a value is wrong.
    """
    try:
        values = yaml.safe_load(file.read_text()) if file else {}
    except (OSError, yaml.YAMLError) as error:
        raise InputError(f"{file} cannot be read: {error}") from error
    if not isinstance(values, dict):
        raise InputError(f"{file}: wanted settings like 'generator: {{batch: 4}}'")
    return validated(TrainingConfig, values, overrides)


def _with_autoencoder(
    folder: "TrainingFolder",
    model: "MaterialDiffusion",
    examples: list[Path],
    config: TrainingConfig,
) -> "MaterialDiffusion":
    """Train the autoencoder unless the model has one."""
    from stages.autoencoder_training import train_autoencoder
    from stages.training_sheet import draw_autoencoder_sheet

    if folder.has_autoencoder:
        return model
    with folder.context("autoencoder", config.generator.checkpoint_every_s) as ctx:
        scale = train_autoencoder(model.autoencoder, examples, config.autoencoder, ctx)
    draw_autoencoder_sheet(model.autoencoder, examples[-1], folder.root / "autoencoder/sheet.png")
    folder.keep_model(model.with_latent_scale(scale))
    return folder.reread_model()


def _train_generator(
    folder: "TrainingFolder",
    model: "MaterialDiffusion",
    examples: list[Path],
    config: TrainingConfig,
    minutes: float | None,
) -> None:
    from stages.generator_training import train_generator
    from stages.latents import precompute_latents
    from stages.training_sheet import draw_generator_sheet
    from svim3d.io.clip_file import read_clip

    with folder.context("latents", config.generator.checkpoint_every_s) as ctx:
        clips = precompute_latents(model, examples, folder.root / "latents", config.latents, ctx)
    shown = [read_clip(clips[i]) for i in SHOWN_CLIPS if i < len(clips)]
    with folder.context("generator", config.generator.checkpoint_every_s) as ctx:
        train_generator(
            model,
            clips,
            config.generator,
            ctx,
            on_checkpoint=lambda steps: folder.keep_model(model, steps=steps),
            on_sheet=lambda steps: draw_generator_sheet(
                model, shown, folder.root / f"generator/sheet-{steps:07d}.png", folder.seed
            ),
            stop_after_s=None if minutes is None else 60.0 * minutes,
        )


class _Teller:
    """Says now and then how far training is."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._last_s = 0.0

    def __call__(self, progress: "Progress") -> None:
        """A line every half minute, and at the end of a part."""
        now = time.monotonic()
        if now - self._last_s < TELL_EVERY_S and progress.step != progress.total:
            return
        self._last_s = now
        terms = ", ".join(f"{name} {value:.4g}" for name, value in progress.terms.items())
        self._console.print(
            f"{progress.stage}: {progress.step} of {progress.total}  {terms}", highlight=False
        )
