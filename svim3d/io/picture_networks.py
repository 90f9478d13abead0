"""Networks that turn pictures into features, read from the files of whoever has them.

Nothing is fetched. What a file has to be, and where it is to be had, is said when it is missing.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

from svim3d.diffusion.checkpoint import fill
from svim3d.diffusion.conditioning import embed_picture
from svim3d.io.weights import load_state, load_tensors
from svim3d.metrics.efficientnet import EfficientNetLite0
from svim3d.metrics.inception import FidInception

# Display-encoded pictures [N, H, W, 3] in [0, 1] -> features [N, d].
Encoder = Callable[[Tensor], Tensor]

CLIP_CONFIG, CLIP_WEIGHTS = "config.json", "model.safetensors"
IMAGE_TOWER = ("vision_model.", "visual_projection.")
POSITIONS = "vision_model.embeddings.position_ids"  # a buffer that older files carry
CLIP_BATCH = 16  # pictures that go through the network at once


def read_efficientnet(file: Path, device: torch.device) -> Encoder:
    """EfficientNet-Lite0 from its published state.

    Raises:
        ValueError: no such file, or another network's.
    """
    return _named(file, lambda: EfficientNetLite0.of(load_state(file)).to(device))


def read_inception(file: Path, device: torch.device) -> Encoder:
    """Inception as FID uses it, from the state that pytorch-fid publishes.

    Raises:
        ValueError: no such file, or another network's.
    """
    return _named(file, lambda: FidInception.of(load_state(file)).to(device))


def read_clip(folder: Path, device: torch.device) -> Encoder:
    """The image tower of a CLIP as transformers saves it: `config.json` and `model.safetensors`.

    Raises:
        ValueError: a file is missing or damaged, or it is no CLIP.
    """
    for name in (CLIP_CONFIG, CLIP_WEIGHTS):
        if not (folder / name).is_file():
            raise ValueError(
                f"wanted a folder with {CLIP_CONFIG} and {CLIP_WEIGHTS} as transformers' "
                f"CLIPModel.save_pretrained writes them, {folder} lacks {name}; pickled weights "
                "are not read: save them as safetensors"
            )
    config = _image_config(folder / CLIP_CONFIG)
    tensors = load_tensors(folder / CLIP_WEIGHTS)
    tower = {n: t for n, t in tensors.items() if n.startswith(IMAGE_TOWER) and n != POSITIONS}
    with torch.device("meta"):
        network = CLIPVisionModelWithProjection(config)
    fill(network, {n: t.to(device, torch.float32) for n, t in tower.items()}, f"CLIP in {folder}")
    network.eval().requires_grad_(False)
    embeddings = network.vision_model.embeddings
    embeddings.position_ids = torch.arange(embeddings.num_positions, device=device)[None]

    def encode(pictures: Tensor) -> Tensor:
        planes = 2.0 * pictures.to(device).float().movedim(-1, 1) - 1.0
        parts = [embed_picture(network, part)[:, 0] for part in planes.split(CLIP_BATCH)]
        return torch.cat(parts)

    return encode


def _image_config(file: Path) -> CLIPVisionConfig:
    """The image tower's part of a CLIP's description.

    Raises:
        ValueError: it is none.
    """
    try:
        told: Any = json.loads(file.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{file} is no JSON ({error}); save the model anew") from error
    vision = told.get("vision_config") if isinstance(told, dict) else None
    if not isinstance(vision, dict):
        raise ValueError(f"wanted the description of a CLIPModel, {file} has no vision_config")
    width = told.get("projection_dim", vision.get("projection_dim"))
    return CLIPVisionConfig(**(vision | ({} if width is None else {"projection_dim": width})))


def _named(file: Path, read: Callable[[], Encoder]) -> Encoder:
    """What `read` gives; a complaint names the file."""
    try:
        return read()
    except ValueError as error:
        if str(file) in str(error):
            raise
        raise ValueError(f"{file}: {error}") from error
