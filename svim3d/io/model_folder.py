"""A model as a folder: `model.json`, a safetensors file per network, and its card.

The folder is complete in itself: nothing is fetched, nothing is pickled.
"""

import importlib.resources
import json
from dataclasses import asdict, fields
from pathlib import Path

import torch

from svim3d.diffusion.checkpoint import fill
from svim3d.diffusion.model import MaterialDiffusion, ModelSpec
from svim3d.io.weights import load_tensors, save_tensors

FORMAT = "svim3d-model/1"
DESCRIPTION, CARD = "model.json", "README.md"
BUNDLED = "models/svim3d-small"  # inside the package


def bundled_model() -> Path:
    """The folder of the model that comes with the program.

    Raises:
        ValueError: this copy of the program has none.
    """
    folder = Path(str(importlib.resources.files("svim3d") / BUNDLED))
    if not (folder / DESCRIPTION).is_file():
        raise ValueError(
            f"wanted the bundled model in {folder}, this copy of the program came without it; "
            "install it anew, or name a model folder with --model"
        )
    return folder


def write_model(
    folder: Path, model: MaterialDiffusion, card: str, dtype: torch.dtype = torch.float16
) -> None:
    """Write all parts, the weights in `dtype`; a model that was read from here stays whole."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, network in model.parts.items():
        tensors = {k: v.detach().to(dtype).contiguous() for k, v in network.state_dict().items()}
        # Read tensors are pages of their file, so that it is replaced and never written over.
        temporary = folder / f"{name}.tmp"
        save_tensors(temporary, tensors)
        temporary.replace(folder / f"{name}.safetensors")
    write_description(folder, model.spec, card)


def write_description(folder: Path, spec: ModelSpec, card: str) -> None:
    """Write all but the weights."""
    description = {"format": FORMAT, **asdict(spec)}
    for name, text in ((CARD, card), (DESCRIPTION, json.dumps(description, indent=1) + "\n")):
        temporary = folder / f"{name}.tmp"
        temporary.write_text(text)
        temporary.replace(folder / name)


def read_spec(folder: Path, name: str = DESCRIPTION) -> ModelSpec:
    """What a model folder says of itself, or a description of that name alone.

    Raises:
        ValueError: no model folder, or one of another format.
    """
    file = folder / name
    if not file.is_file():
        raise ValueError(
            f"wanted a model folder with {DESCRIPTION}, {folder} has none; "
            "make one with svim3d model convert, or leave the model out to use the bundled one"
        )
    try:
        description = json.loads(file.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{file} is no JSON ({error}); restore it from a backup") from error
    found = description.pop("format", None) if isinstance(description, dict) else None
    if found != FORMAT:
        raise ValueError(f"wanted a model of format {FORMAT}, {file} says {found!r}")
    known = {f.name for f in fields(ModelSpec)}
    if unknown := sorted(set(description) - known):
        raise ValueError(f"{file} has unknown entries: {', '.join(unknown)}")
    try:
        description["groups"] = tuple(description["groups"])
        return ModelSpec(**description)
    except (TypeError, KeyError) as error:
        raise ValueError(f"{file} lacks entries: {error}") from error


def read_model(
    folder: Path, device: torch.device, dtype: torch.dtype = torch.float32
) -> MaterialDiffusion:
    """A model ready to draw with.

    Args:
        folder: as `write_model` leaves it.
        device: where the weights go.
        dtype: of the weights once read; sampling keeps its state in float32.

    Raises:
        ValueError: a file that is missing or damaged; missing, unexpected or misshapen tensors,
            named.
    """
    spec = read_spec(folder)
    with torch.device("meta"):
        model = MaterialDiffusion.untrained(spec)
    for name, network in model.parts.items():
        tensors = load_tensors(folder / f"{name}.safetensors")
        fill(network, {k: v.to(device, dtype) for k, v in tensors.items()}, name)
        network.eval().requires_grad_(False)
    # The one buffer that no file holds: the indices of the image encoder's patches.
    embeddings = model.image_encoder.vision_model.embeddings
    embeddings.position_ids = torch.arange(embeddings.num_positions, device=device)[None]
    return model
