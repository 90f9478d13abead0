"""Networks learn in half precision where the device can multiply it, and nowhere else."""

import pytest
import torch

from stages.precision import products_in

CPU = torch.device("cpu")


@pytest.mark.parametrize(
    ("precision", "able", "product"),
    [
        ("float32", {"avx512_bf16": True}, torch.float32),
        ("bfloat16", {}, torch.bfloat16),
        ("auto", {"avx512_bf16": True}, torch.bfloat16),
        ("auto", {"avx2": True, "avx512_bf16": False}, torch.float32),
        ("auto", {}, torch.float32),
    ],
)
def test_products_are_of_what_the_processor_multiplies(precision, able, product, monkeypatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: able)
    numbers = torch.ones(4, 4)
    with products_in(precision, CPU):
        assert (numbers @ numbers).dtype == product
    assert (numbers @ numbers).dtype == torch.float32
