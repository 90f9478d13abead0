"""A GPU computes for one at a time; a slot never outlives its process."""

import fcntl
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from stages.device_slot import device_slot

PROJECT = Path(__file__).resolve().parents[2]
FAKE = """
import sys
from pathlib import Path
from types import SimpleNamespace
import torch
torch.cuda.get_device_properties = lambda device: SimpleNamespace(uuid="one")
torch.cuda.empty_cache = lambda: None
from stages.device_slot import device_slot
with device_slot(torch.device("cuda"), Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def gpu(monkeypatch):
    """A device that no machine has, so that the test runs on all."""
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _: SimpleNamespace(uuid="one"))
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: None)
    return torch.device("cuda")


def is_held(folder: Path) -> bool:
    (file,) = folder.glob("svim3d-*-one.lock")
    with file.open("a") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def test_slot_is_held_for_the_block(gpu, tmp_path):
    with device_slot(gpu, tmp_path):
        assert is_held(tmp_path)
    assert not is_held(tmp_path)
    with pytest.raises(KeyError), device_slot(gpu, tmp_path):
        raise KeyError
    assert not is_held(tmp_path)


def test_processor_needs_none(tmp_path):
    with device_slot(torch.device("cpu"), tmp_path):
        assert list(tmp_path.iterdir()) == []


def test_killed_holder_lets_go(gpu, tmp_path):
    holder = subprocess.Popen(
        [sys.executable, "-c", FAKE, str(tmp_path)],
        cwd=PROJECT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert holder.stdout.readline() == "held\n" and is_held(tmp_path)
    holder.kill()
    holder.communicate()
    assert not is_held(tmp_path)
    with device_slot(gpu, tmp_path):
        pass
