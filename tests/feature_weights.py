"""States of the networks that give features, with weights that a formula gives."""

import torch

# EfficientNet-Lite0: width before, width inside, width behind, kernel.
LITE0_BLOCKS = (
    (32, 32, 16, 3),
    (16, 96, 24, 3),
    (24, 144, 24, 3),
    (24, 144, 40, 5),
    (40, 240, 40, 5),
    (40, 240, 80, 3),
    *[(80, 480, 80, 3)] * 2,
    (80, 480, 112, 5),
    *[(112, 672, 112, 5)] * 2,
    (112, 672, 192, 5),
    *[(192, 1152, 192, 5)] * 3,
    (192, 1152, 320, 3),
)


def wave(place: int, shape: tuple[int, ...]) -> torch.Tensor:
    """Numbers in [-1, 1] that are the same wherever, of another wave for each place."""
    count = torch.Size(shape).numel()
    phase = torch.arange(count).double() * (0.7 + 0.013 * (place % 100)) + place
    return torch.sin(phase * phase.sqrt()).view(shape).float()


def formula_state(convolutions, norms, *, gain: float):
    """Weights for named convolutions (shape by name) and normalisations (width by name)."""
    state = {}
    for place, (name, shape) in enumerate(sorted(convolutions.items())):
        fan_in = torch.Size(shape[1:]).numel()
        state[f"{name}.weight"] = wave(place, shape) * (gain / fan_in) ** 0.5
    for place, (name, width) in enumerate(sorted(norms.items())):
        state[f"{name}.weight"] = 1.0 + 0.2 * wave(place, (width,))
        state[f"{name}.bias"] = 0.1 * wave(place + 1, (width,))
        state[f"{name}.running_mean"] = 0.1 * wave(place + 2, (width,))
        state[f"{name}.running_var"] = 1.0 + 0.5 * wave(place + 3, (width,))
    return state


def lite0_state():
    convolutions, norms = {"_conv_stem": (32, 3, 3, 3), "_conv_head": (1280, 320, 1, 1)}, {}
    norms |= {"_bn0": 32, "_bn1": 1280}
    for index, (before, inside, behind, kernel) in enumerate(LITE0_BLOCKS):
        stem = f"_blocks.{index}."
        if index:
            convolutions[f"{stem}_expand_conv"] = (inside, before, 1, 1)
            norms[f"{stem}_bn0"] = inside
        convolutions[f"{stem}_depthwise_conv"] = (inside, 1, kernel, kernel)
        convolutions[f"{stem}_project_conv"] = (behind, inside, 1, 1)
        norms |= {f"{stem}_bn1": inside, f"{stem}_bn2": behind}
    return formula_state(convolutions, norms, gain=4.0)


# Inception's convolutions: width before, width behind, kernel.
def _squares(before, pooled):
    return {
        "branch1x1": (before, 64, 1, 1),
        "branch5x5_1": (before, 48, 1, 1),
        "branch5x5_2": (48, 64, 5, 5),
        "branch3x3dbl_1": (before, 64, 1, 1),
        "branch3x3dbl_2": (64, 96, 3, 3),
        "branch3x3dbl_3": (96, 96, 3, 3),
        "branch_pool": (before, pooled, 1, 1),
    }


def _stripes(width):
    flat, tall = (width, width, 1, 7), (width, width, 7, 1)
    return {
        "branch1x1": (768, 192, 1, 1),
        "branch7x7_1": (768, width, 1, 1),
        "branch7x7_2": flat,
        "branch7x7_3": (width, 192, 7, 1),
        "branch7x7dbl_1": (768, width, 1, 1),
        "branch7x7dbl_2": tall,
        "branch7x7dbl_3": flat,
        "branch7x7dbl_4": tall,
        "branch7x7dbl_5": (width, 192, 1, 7),
        "branch_pool": (768, 192, 1, 1),
    }


def _forks(before):
    return {
        "branch1x1": (before, 320, 1, 1),
        "branch3x3_1": (before, 384, 1, 1),
        "branch3x3_2a": (384, 384, 1, 3),
        "branch3x3_2b": (384, 384, 3, 1),
        "branch3x3dbl_1": (before, 448, 1, 1),
        "branch3x3dbl_2": (448, 384, 3, 3),
        "branch3x3dbl_3a": (384, 384, 1, 3),
        "branch3x3dbl_3b": (384, 384, 3, 1),
        "branch_pool": (before, 192, 1, 1),
    }


INCEPTION_BLOCKS = {
    "Mixed_5b": _squares(192, 32),
    "Mixed_5c": _squares(256, 64),
    "Mixed_5d": _squares(288, 64),
    "Mixed_6a": {
        "branch3x3": (288, 384, 3, 3),
        "branch3x3dbl_1": (288, 64, 1, 1),
        "branch3x3dbl_2": (64, 96, 3, 3),
        "branch3x3dbl_3": (96, 96, 3, 3),
    },
    "Mixed_6b": _stripes(128),
    "Mixed_6c": _stripes(160),
    "Mixed_6d": _stripes(160),
    "Mixed_6e": _stripes(192),
    "Mixed_7a": {
        "branch3x3_1": (768, 192, 1, 1),
        "branch3x3_2": (192, 320, 3, 3),
        "branch7x7x3_1": (768, 192, 1, 1),
        "branch7x7x3_2": (192, 192, 1, 7),
        "branch7x7x3_3": (192, 192, 7, 1),
        "branch7x7x3_4": (192, 192, 3, 3),
    },
    "Mixed_7b": _forks(1280),
    "Mixed_7c": _forks(2048),
}
INCEPTION_STEM = {
    "Conv2d_1a_3x3": (3, 32, 3, 3),
    "Conv2d_2a_3x3": (32, 32, 3, 3),
    "Conv2d_2b_3x3": (32, 64, 3, 3),
    "Conv2d_3b_1x1": (64, 80, 1, 1),
    "Conv2d_4a_3x3": (80, 192, 3, 3),
}


def inception_state():
    shapes = dict(INCEPTION_STEM)
    for block, inside in INCEPTION_BLOCKS.items():
        shapes |= {f"{block}.{name}": shape for name, shape in inside.items()}
    convolutions = {f"{n}.conv": (out, into, *side) for n, (into, out, *side) in shapes.items()}
    norms = {f"{n}.bn": shape[1] for n, shape in shapes.items()}
    state = formula_state(convolutions, norms, gain=4.0)
    return state | {"fc.weight": torch.zeros(1008, 2048), "fc.bias": torch.zeros(1008)}


def formula_pictures(height: int, width: int) -> torch.Tensor:
    """Two smooth pictures in [0, 1] with something in every corner."""
    y = torch.linspace(0, 1, height)[:, None]
    x = torch.linspace(0, 1, width)[None]
    planes = [
        0.5 + 0.5 * torch.sin(9.0 * x + 5.0 * k * y * y + k) * torch.cos(7.0 * y - 3.0 * x * k)
        for k in range(6)
    ]
    return torch.stack(planes, -1).view(height, width, 2, 3).movedim(2, 0).contiguous()
