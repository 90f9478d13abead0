"""A model as a folder: `model.json`, a safetensors file per network, and its card.

The folder is complete in itself: nothing is fetched, nothing is pickled.
"""

import importlib.resources
import json
from dataclasses import asdict, fields
from pathlib import Path

import torch

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
    """Write all parts, the weights in `dtype`."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, network in model.parts.items():
        tensors = {k: v.detach().to(dtype).contiguous() for k, v in network.state_dict().items()}
        save_tensors(folder / f"{name}.safetensors", tensors)
    description = {"format": FORMAT, **asdict(model.spec)}
    (folder / DESCRIPTION).write_text(json.dumps(description, indent=1) + "\n")
    (folder / CARD).write_text(card)


def read_spec(folder: Path) -> ModelSpec:
    """What a model folder says of itself.

    Raises:
        ValueError: no model folder, or one of another format.
    """
    file = folder / DESCRIPTION
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
        ValueError: missing, unexpected or misshapen tensors, named.
    """
    spec = read_spec(folder)
    with torch.device("meta"):
        model = MaterialDiffusion.untrained(spec)
    for name, network in model.parts.items():
        tensors = load_tensors(folder / f"{name}.safetensors")
        fill(network, {k: v.to(device, dtype) for k, v in tensors.items()}, name)
        _number_positions(network, device)
        network.eval().requires_grad_(False)
    return model


def _number_positions(network: torch.nn.Module, device: torch.device) -> None:
    """Give CLIP's embedding the numbers of its positions, which are in no file and still on meta.

    Any other such buffer would be noticed: the first use of a tensor on meta fails.
    """
    for module in network.modules():
        positions = getattr(module, "position_ids", None)
        if isinstance(positions, torch.Tensor) and positions.is_meta:
            module.position_ids = torch.arange(positions.shape[-1], device=device)[None]


def fill(network: torch.nn.Module, tensors: dict[str, torch.Tensor], what: str) -> None:
    """Give a network on the meta device its weights.

    Raises:
        ValueError: names the first few missing, unexpected and misshapen tensors.
    """
    wanted = network.state_dict()
    complaints = {
        "missing": sorted(set(wanted) - set(tensors)),
        "unexpected": sorted(set(tensors) - set(wanted)),
        "of another shape": [
            f"{name} {tuple(tensors[name].shape)} for {tuple(value.shape)}"
            for name, value in wanted.items()
            if name in tensors and tensors[name].shape != value.shape
        ],
    }
    told = [
        f"{len(names)} {kind} ({', '.join(names[:3])}{', ...' if len(names) > 3 else ''})"
        for kind, names in complaints.items()
        if names
    ]
    if told:
        raise ValueError(f"{what}: the tensors do not fit the network: {'; '.join(told)}")
    network.load_state_dict(tensors, assign=True)
