"""Kernels: what a process compiles itself computes the bytes that it reads from the disk later."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """
import hashlib
import numpy as np
from svim3d.render.compositing import _accumulate_kernel, _weights_kernel

random = np.random.default_rng(0)
count, rays = 20_000, 1_000
inner = np.sort(random.integers(0, count, rays - 1))
starts = np.concatenate([[0], inner, [count]]).astype(np.int64)
opacity = (0.3 * random.random(count)).astype(np.float32)
weights, passed = np.empty_like(opacity), np.empty_like(opacity)
_weights_kernel(opacity, starts, weights, passed)
digest = hashlib.sha256(weights.tobytes())
for channels in (1, 3):
    values = random.random((count, channels)).astype(np.float32)
    out = np.zeros((rays, channels), np.float32)
    _accumulate_kernel(weights, values, starts, out)
    digest.update(out.tobytes())
print(digest.hexdigest())
"""
PROJECT = Path(__file__).resolve().parents[2]


def run(cache: Path) -> str:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": str(PROJECT)}
    command = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return done.stdout


@pytest.mark.slow
def test_a_compiled_kernel_computes_what_a_cached_one_does(tmp_path):
    first = run(tmp_path)
    assert list(tmp_path.rglob("*.nbc")), "the kernels were not kept"
    assert run(tmp_path) == first
