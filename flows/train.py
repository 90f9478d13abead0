"""`svim3d train`: rendered examples in, a model folder out; goes on where it was stopped.

Autoencoder, latents, expectation, generator: each part keeps its state in the run's folder, and
what is done is not done again. `--minutes` cuts a long training into pieces that end like one.
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

TELL_EVERY_S = 30.0
SHOWN_CLIPS = 2  # orbits on a sheet


def train(options: argparse.Namespace) -> int:
    """Train what the command line names; see `svim3d train --help`."""
    config = load_training_config(options.config, options.set)
    from stages.autoencoder_training import train_autoencoder
    from stages.execution import choose_device
    from stages.expectation_training import train_expectation
    from stages.generator_training import train_generator
    from stages.latents import precompute_latents, read_fitting
    from stages.training_folder import TrainingFolder, examples_of, load_model_spec
    from stages.training_sheet import draw_autoencoder_sheet, draw_generator_sheet

    started_s = time.monotonic()

    def time_left_s() -> float | None:
        """Of the minutes that were given."""
        given = options.minutes
        return None if given is None else max(0.0, 60.0 * given + started_s - time.monotonic())

    examples = examples_of(options.data)
    spec = load_model_spec(options.model)
    console = Console()
    folder = TrainingFolder(
        options.output, options.seed, choose_device(options.device), _Teller(console)
    )
    folder.require_same(config, spec, examples[0])
    read_fitting(examples[0], spec)
    from_scratch = not options.model.is_dir()
    interrupt_on_stop()
    every_s = config.generator.checkpoint_every_s
    model = folder.start_model(spec, options.model)
    if not folder.has_autoencoder:
        with folder.context("autoencoder", every_s) as ctx:
            scale = train_autoencoder(model.autoencoder, examples, config.autoencoder, ctx)
        sheet = folder.root / "autoencoder" / "sheet.png"
        draw_autoencoder_sheet(model.autoencoder, examples[-1], sheet)
        folder.keep_model(model.described(latent_scale=scale))
        model = folder.reread_model()
    with folder.context("latents", every_s) as ctx:
        clips = precompute_latents(
            model,
            examples,
            folder.root / "latents",
            config.latents,
            ctx,
            embedded=not from_scratch,
        )
    if model.expectation is not None and from_scratch:
        with folder.context("expectation", every_s) as ctx:
            left_open = train_expectation(model, clips, config.expectation, ctx, time_left_s())
        if left_open is None:
            console.print(f"{folder.root}: the expectation is half trained; run the same again")
            return DONE
        if left_open != model.spec.residual_scale:
            folder.keep_model(model.described(residual_scale=left_open))
        model = folder.reread_model()
    with folder.context("generator", every_s) as ctx:
        steps = train_generator(
            model,
            clips,
            config.generator,
            ctx,
            from_scratch=from_scratch,
            on_checkpoint=lambda steps: folder.keep_model(model, steps=steps),
            on_sheet=lambda steps: draw_generator_sheet(
                model,
                clips[:SHOWN_CLIPS],
                folder.root / "generator" / f"sheet-{steps:07d}.png",
                folder.seed,
            ),
            stop_after_s=time_left_s(),
        )
    # Also after a kill between the last checkpoint and the model that belongs to it.
    folder.keep_model(model, steps)
    console.print(
        f"{folder.model_folder}: a model for svim3d run --model", highlight=False, soft_wrap=True
    )
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
