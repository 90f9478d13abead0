"""What all tests share: shape checking, quiet thread pools, contexts, real data where it lies."""

import math
import os

# Before torch and numba are imported. Pools that spin starve each other; with one worker per core
# a thread each is right. Our kernels give the same bits with any number of threads, torch's sums
# and matrix products the same to rounding.
os.environ.setdefault("GOMP_SPINCOUNT", "0")
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ["OMP_NUM_THREADS"] = os.environ["NUMBA_NUM_THREADS"] = "1"

from jaxtyping import install_import_hook

# Shapes and types of the library are checked at every call, here and nowhere else.
install_import_hook(["svim3d"], "shape_checking.check_types")

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from stages.base import Context


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip what needs a GPU where there is none: README's command runs every test."""
    if not torch.cuda.is_available():
        for item in items:
            if item.get_closest_marker("gpu"):
                item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))


@pytest.fixture
def make_context(tmp_path: Path) -> Callable[..., Context]:
    """`make_context("nerf")`: a context of that stage in a folder of its own.

    The same name gives the same work folder, so a second context resumes what the first left;
    that is nothing unless the test asks for checkpoints, however slow the machine is.
    """

    def make(stage: str, *, seed: int = 0, **rest) -> Context:
        rest.setdefault("checkpoint_every_s", math.inf)
        return Context(
            stage,
            torch.device("cpu"),
            seed,
            work=tmp_path / "work" / stage,
            shared=tmp_path / "shared",
            **rest,
        )

    return make


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real inputs that SVIM3D_DATA names; without it the test is skipped."""
    folder = os.environ.get("SVIM3D_DATA")
    if not folder:
        pytest.skip("SVIM3D_DATA names no folder with real inputs")
    return Path(folder)
