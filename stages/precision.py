"""In what precision networks multiply while they learn."""

import torch

from stages.settings.training import Precision

# A processor without one of these takes bfloat16 apart number by number: 80 times slower than
# float32, measured on a Zen 2 with torch 2.13.
MULTIPLIES_BFLOAT16 = ("avx512_bf16", "amx_bf16", "bf16")


def products_in(precision: Precision, device: torch.device) -> torch.autocast:
    """A context in which matrix products are of this precision; parameters stay as they are.

    Args:
        precision: `auto` takes bfloat16 where the device multiplies it, float32 elsewhere.
        device: where to compute.
    """
    is_half = precision == "bfloat16"
    if precision == "auto":
        able = torch.cpu.get_capabilities()
        is_half = device.type == "cuda" or any(able.get(name) for name in MULTIPLIES_BFLOAT16)
    return torch.autocast(device.type, torch.bfloat16, enabled=is_half)
