"""`svim3d train`: rendered examples in, a model folder out; goes on where it was stopped.

Autoencoder, look, latents, expectation, generator: each part keeps its state in the run's folder,
and what is done is not done again. `--minutes` cuts a long training into pieces that end like one.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import yaml
from rich.console import Console

from flows.config import validated
from flows.job import DONE
from flows.stopping import interrupt_on_stop
from stages.errors import InputError
from stages.locks import file_lock
from stages.settings.training import TrainingConfig

if TYPE_CHECKING:
    from stages.base import Progress
    from stages.training_folder import TrainingFolder

TELL_EVERY_S = 30.0
LOCK = "lock"
SHOWN_CLIPS = 2  # orbits on a sheet


def train(options: argparse.Namespace) -> int:
    """Train what the command line names; see `svim3d train --help`.

    Raises:
        InputError: wrong settings, model or data, or another process trains in the folder.
    """
    config = load_training_config(options.config, options.set)
    from stages.execution import choose_device
    from stages.latents import read_fitting
    from stages.training_folder import TrainingFolder, examples_of, load_model_spec

    examples = examples_of(options.data)
    spec = load_model_spec(options.model)
    console = Console()
    folder = TrainingFolder(
        options.output, options.seed, choose_device(options.device), _Teller(console)
    )
    with file_lock(folder.root / LOCK) as is_ours:
        if not is_ours:
            raise InputError(
                f"another process trains in {folder.root}; wait for it, or take another folder"
            )
        folder.require_same(config, spec, examples[0])
        read_fitting(examples[0], spec)
        interrupt_on_stop()
        over_s = None if options.minutes is None else time.monotonic() + 60.0 * options.minutes
        _train(folder, options.model, examples, config, over_s, console)
    return DONE


def _train(
    folder: "TrainingFolder",
    source: Path,
    examples: Sequence[Path],
    config: TrainingConfig,
    over_s: float | None,
    console: Console,
) -> None:
    """Every part in turn; `over_s` is the moment to stop at."""
    from stages.generator_training import train_generator
    from stages.latents import precompute_latents
    from stages.training_sheet import draw_generator_sheet

    def time_left_s() -> float | None:
        return None if over_s is None else max(0.0, over_s - time.monotonic())

    from_scratch = not source.is_dir()
    every_s = config.generator.checkpoint_every_s
    _start(folder, source, examples, config)
    _look(folder, examples, config)
    with folder.context("latents", every_s) as ctx:
        clips = precompute_latents(
            folder.reread_model(),
            examples,
            folder.root / "latents",
            config.latents,
            ctx,
            embedded=not from_scratch,
        )
    if not _expect(folder, clips, config, from_scratch, time_left_s()):
        console.print(f"{folder.root}: the expectation is half trained; run the same again")
        return
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


def _start(
    folder: "TrainingFolder", source: Path, examples: Sequence[Path], config: TrainingConfig
) -> None:
    """Let the folder hold a model with a trained autoencoder."""
    from stages.autoencoder_training import train_autoencoder
    from stages.training_folder import load_model_spec
    from stages.training_sheet import draw_autoencoder_sheet

    model = folder.start_model(load_model_spec(source), source)
    if folder.has_autoencoder:
        return
    with folder.context("autoencoder", config.generator.checkpoint_every_s) as ctx:
        scale = train_autoencoder(model.autoencoder, examples, config.autoencoder, ctx)
    sheet = folder.root / "autoencoder" / "sheet.png"
    draw_autoencoder_sheet(model.autoencoder, examples[-1], sheet)
    folder.keep_model(model.described(latent_scale=scale))


def _look(folder: "TrainingFolder", examples: Sequence[Path], config: TrainingConfig) -> None:
    """Train the look of the folder's model, if it has one and this run has not done so."""
    from stages.look_training import train_look
    from stages.training_folder import LOOK

    model = folder.reread_model()
    if model.look is None or not config.look.steps or folder.has_look:
        return
    with folder.context(LOOK, config.generator.checkpoint_every_s) as ctx:
        train_look(model, examples, config.look, ctx)
    folder.keep_model(model)
    folder.mark_look()


def _expect(
    folder: "TrainingFolder",
    clips: Sequence[Path],
    config: TrainingConfig,
    from_scratch: bool,
    stop_after_s: float | None,
) -> bool:
    """Train the expectation of the folder's model, if it has one; False if stopped before."""
    from stages.expectation_training import train_expectation

    model = folder.reread_model()
    steps = config.expectation.steps if from_scratch else config.expectation.steps_on
    if model.expectation is None or not steps:
        return True
    settings = config.expectation.model_copy(update={"steps": steps})
    with folder.context("expectation", config.generator.checkpoint_every_s) as ctx:
        left_open = train_expectation(model, clips, settings, ctx, stop_after_s)
    if left_open not in (None, model.spec.residual_scale):
        folder.keep_model(model.described(residual_scale=left_open))
    return left_open is not None


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
