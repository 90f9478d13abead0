"""Model files: a single-file checkpoint as a model folder, and what a file or folder holds.

Not a stage of a pipeline: a model is converted once and then is an input.
"""

import math
import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path

import torch
from torch import Tensor

from stages.errors import InputError
from svim3d.diffusion.checkpoint import Kind, detect, require_cameras, require_fit, spec_of
from svim3d.diffusion.inflation import Copies, Inflation
from svim3d.diffusion.key_map import AUTOENCODER, SECOND_DECODER, Move, Sorted, sort_names
from svim3d.diffusion.model import MaterialDiffusion, ModelSpec
from svim3d.io.model_folder import CARD, DESCRIPTION, read_spec, write_description
from svim3d.io.weights import Shape, TensorFile, open_tensors, save_one_by_one

PARTS = ("unet", "autoencoder", "image_encoder")  # of a single file
NOTICE = "NOTICE"
DTYPES = {"fp16": torch.float16, "bf16": torch.bfloat16, "fp32": torch.float32}

LICENSE = "Stability AI Non-Commercial Research Community License (18 March 2024)"
CARD_TEXT = f"""\
# {{name}}

Licence: {LICENSE}

Converted by `svim3d model convert` from `{{file}}` ({{kind}}): weights in {{dtype}}, {{channels}}.
{{state}}

## What the licence asks

The weights are Stability AI's Stable Video 3D or derived from it. This folder, every model trained
from it, and every model trained on its output inherit that licence: research and non-commercial use
only, and no service that lets others use the model. Whoever passes it on adds a copy of the licence
and keeps the file `{NOTICE}`, which says what was changed. The licence text came with the weights;
newer releases of Stability AI may have other terms, so check those of your copy.

The code that reads this folder has a licence of its own and does not change this one.
"""
UNTRAINED = (
    "Groups beyond RGB begin as copies of RGB: until it is trained on materials, this model "
    "answers\nwith colour in all of them."
)
NOTICE_TEXT = """\
This Stability AI Model is licensed under the Stability AI Non-Commercial Research Community
License, Copyright (c) Stability AI Ltd. All Rights Reserved.

Changes to it: tensors were renamed for other libraries and stored in {dtype}; the text tower and
the second picture decoder were left out; {channels}.
"""


def convert(
    file: Path, out: Path, *, groups: int, copies: Copies, dtype: str
) -> tuple[ModelSpec, list[str]]:
    """Write a single-file checkpoint as a model folder; tells what was done.

    One tensor at a time is in memory. A folder is complete or not there.

    Args:
        file: safetensors in the layout of SV3D_p.
        out: new or empty folder.
        groups: pictures per view of the new model; more than the file has are made by inflation.
        copies: how the weights of new input channels are scaled.
        dtype: of all stored weights, `fp16`, `bf16` or `fp32`.

    Raises:
        InputError: the file is another kind, tensors are missing, unexpected or misshapen (named),
            or the folder is taken or cannot be written.
    """
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise InputError(f"{out} is there already; choose another folder or remove it")
    partial = out.resolve().with_name(f".{out.resolve().name}.partial")
    try:
        with open_tensors(file) as tensors:
            spec, told = _convert(tensors, file, partial, groups, copies, dtype)
        if out.exists():
            out.rmdir()
        partial.replace(out)
    except OSError as error:
        raise InputError(f"{out} cannot be written: {error}") from error
    except ValueError as error:
        raise InputError(_naming(file, error)) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return spec, told


def _convert(
    tensors: TensorFile, file: Path, folder: Path, groups: int, copies: Copies, dtype: str
) -> tuple[ModelSpec, list[str]]:
    """Check everything by names and shapes first; then write part by part."""
    kind = detect(tensors.shapes)
    require_cameras(kind)
    found = sort_names(tensors.shapes)
    if found.unknown:
        raise ValueError(
            f"{len(found.unknown)} tensors that {Kind.SV3D_P} does not have: "
            f"{', '.join(sorted(found.unknown)[:3])}; wanted sv3d_p.safetensors"
        )
    plan = {part: [move for move in found.moves if move.part == part] for part in PARTS}
    shapes = {part: _shapes_after(moves, tensors.shapes) for part, moves in plan.items()}
    spec = spec_of(file.stem, shapes)
    _require_fits(spec, shapes)
    channels = f"all {spec.unet['out_channels']} output channels kept"
    inflation = None
    if groups != len(spec.groups):
        if len(spec.groups) > 1:
            raise ValueError(f"the model has {len(spec.groups)} groups already; ask for as many")
        inflation = Inflation(int(spec.autoencoder["latent_channels"]), groups, copies)
        shapes["unet"] = {
            name: tuple(inflation.carry_out(name, torch.empty(shape, device="meta")).shape)
            for name, shape in shapes["unet"].items()
        }
        channels = f"{spec.unet['out_channels']} output channels made "
        spec = spec_of(f"{file.stem}-{groups}-groups", shapes)
        channels += f"{spec.unet['out_channels']} by copying ({copies})"

    folder.mkdir(parents=True, exist_ok=True)
    for part, moves in plan.items():
        source = _moved(tensors, moves)
        if part == "unet" and inflation is not None:
            source = ((name, inflation.carry_out(name, t)) for name, t in source)
        save_one_by_one(folder / f"{part}.safetensors", shapes[part], DTYPES[dtype], source)
    state = UNTRAINED if inflation else ""
    texts = {"file": file.name, "kind": kind, "dtype": dtype, "channels": channels}
    write_description(folder, spec, CARD_TEXT.format(name=spec.name, state=state, **texts))
    (folder / NOTICE).write_text(NOTICE_TEXT.format(dtype=dtype, channels=channels))
    return spec, [f"{kind}: {channels}", *_left_out(tensors, found)]


def _shapes_after(moves: list[Move], shapes: Mapping[str, Shape]) -> dict[str, Shape]:
    """Shapes of a network's tensors once they are moved."""
    after: dict[str, Shape] = {}
    for move in moves:
        moved = move.carry_out(torch.empty(shapes[move.source], device="meta"))
        after |= {name: tuple(tensor.shape) for name, tensor in moved.items()}
    return after


def _moved(tensors: TensorFile, moves: list[Move]) -> Iterator[tuple[str, Tensor]]:
    for move in moves:
        yield from move.carry_out(tensors.read(move.source)).items()


def _require_fits(spec: ModelSpec, shapes: Mapping[str, Mapping[str, Shape]]) -> None:
    """Ask every network of a model whether these tensors are its own."""
    with torch.device("meta"):
        model = MaterialDiffusion.untrained(spec)
    for part, network in model.parts.items():
        require_fit(network, shapes[part], part)


def _left_out(tensors: TensorFile, found: Sorted) -> list[str]:
    """What of a file no network takes, and whether it matters."""
    told = []
    if found.text_tower:
        told.append(f"left out: {len(found.text_tower)} tensors of CLIP's text tower")
    if found.second_decoder:
        differing = [
            name
            for name, twin in found.second_decoder.items()
            if twin not in tensors.shapes or not torch.equal(tensors.read(name), tensors.read(twin))
        ]
        same = f"{len(differing)} of its tensors differ" if differing else "it is the same"
        told.append(
            f"left out: the second decoder, {SECOND_DECODER}*; that of the autoencoder, "
            f"{AUTOENCODER}decoder.*, is used ({same})"
        )
    return told


def describe(path: Path) -> tuple[list[tuple[str, str]], list[str]]:
    """Name and value of what a model folder or a single file holds, and what is wrong with it.

    Raises:
        InputError: neither, or a file that cannot be read.
    """
    try:
        if path.is_dir():
            return _describe_folder(path)
        with open_tensors(path) as tensors:
            return _describe_file(tensors)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error}") from error
    except ValueError as error:
        raise InputError(_naming(path, error)) from error
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: {DESCRIPTION} is damaged: {error!r}") from error


def _describe_folder(folder: Path) -> tuple[list[tuple[str, str]], list[str]]:
    spec = read_spec(folder)
    rows = [("kind", "model folder"), ("name", spec.name)]
    shapes: dict[str, dict[str, Shape]] = {}
    types: set[str] = set()
    more = [name for name in ("expectation", "look") if getattr(spec, name)]
    for part in (*PARTS, *more):
        with open_tensors(folder / f"{part}.safetensors") as tensors:
            shapes[part] = tensors.shapes
            types |= set(tensors.types.values())
        rows.append((part, _parameters(shapes[part])))
    rows += [("stored as", ", ".join(sorted(types))), *_settings(spec)]
    card = folder / CARD
    text = card.read_text(errors="replace") if card.is_file() else ""
    rows.append(("licence", license_line(text) or f"not said: {CARD} has no line on it"))
    return rows, _faults(spec, shapes)


def _describe_file(tensors: TensorFile) -> tuple[list[tuple[str, str]], list[str]]:
    kind = detect(tensors.shapes)
    found = sort_names(tensors.shapes)
    shapes = {
        part: _shapes_after([m for m in found.moves if m.part == part], tensors.shapes)
        for part in PARTS
    }
    rows = [("kind", f"single file, {kind}")]
    rows += [(part, _parameters(shapes[part])) for part in PARTS]
    for name, names in (
        ("second decoder", list(found.second_decoder)),
        ("text tower", found.text_tower),
        ("unknown", found.unknown),
    ):
        if names:
            counted = _parameters({n: tensors.shapes[n] for n in names})
            rows.append((name, f"{counted}, left out"))
    rows.append(("stored as", ", ".join(sorted(set(tensors.types.values())))))
    licence = ("licence", f"that of the weights; of SV3D's: {LICENSE}")
    try:
        require_cameras(kind)
        spec = spec_of(kind, shapes)
    except ValueError as error:
        return [*rows, licence], [str(error)]
    return [*rows, *_settings(spec), licence], _faults(spec, shapes)


def _parameters(shapes: Mapping[str, Shape]) -> str:
    count = sum(math.prod(shape) for shape in shapes.values())
    return f"{count:,} parameters in {len(shapes):,} tensors"


def _settings(spec: ModelSpec) -> list[tuple[str, str]]:
    """What a model makes and how it is sampled unless asked otherwise."""
    channels = f"{spec.unet['in_channels']} in, {spec.unet['out_channels']} out"
    picture, latent = spec.image_size, spec.latent_side
    return [
        ("channels", f"{channels}, {spec.latent_channels} per group"),
        ("groups", ", ".join(spec.groups)),
        ("views", f"{spec.views} of {picture} x {picture} px, latents {latent} x {latent}"),
        ("field of view", f"{spec.fov_deg:g} degrees"),
        (
            "sampler",
            f"{spec.steps} steps, noise {spec.sigma_max:g} to {spec.sigma_min:g} (rho "
            f"{spec.rho:g}), guidance {spec.guidance_min:g} to {spec.guidance_max:g}",
        ),
    ]


def _faults(spec: ModelSpec, shapes: Mapping[str, Mapping[str, Shape]]) -> list[str]:
    try:
        _require_fits(spec, shapes)
    except (ValueError, TypeError) as error:  # the description may not even make networks
        return [str(error)]
    return []


def license_line(card: str) -> str | None:
    """What a model card says of its licence: a line that begins so, or what stands below one."""
    lines = [line.strip(" #*_-") for line in card.splitlines()]
    for index, line in enumerate(lines):
        if matched := re.match(r"licen[cs]e\b[\s:*_]*(.*)", line, re.IGNORECASE):
            return matched[1] or next((later for later in lines[index + 1 :] if later), None)
    return None


def _naming(path: Path, error: Exception) -> str:
    """A message that says which file it is about."""
    return str(error) if str(path) in str(error) else f"{path}: {error}"
