"""A service whose jobs are carried out by a tiny script; a job's seed says how it behaves."""

import io
import sys
import time
from pathlib import Path

from fastapi.testclient import TestClient
from PIL import Image

from flows.service.records import Record

FAKE = Path(__file__).with_name("fake_run.py")
PATIENCE_S = 20.0  # a machine that does other things too


def command(record: Record, folder: Path) -> list[str]:
    source, out = folder / record.input, folder / "run"
    return [sys.executable, "-S", str(FAKE), str(record.seed), str(source), str(out)]


def png(size: tuple[int, int] = (4, 4)) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", size, (200, 10, 10)).save(buffer, "PNG")
    return buffer.getvalue()


def wait_for(client: TestClient, job: str, *states: str) -> dict:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        view = client.get(f"/jobs/{job}").json()
        if view["state"] in states:
            return view
        time.sleep(0.02)
    raise AssertionError(f"the job is still {view}")


def send(client: TestClient, seed: int = 0, **fields) -> str:
    answer = client.post(
        "/jobs", files={"picture": ("x.png", png())}, data={"seed": seed, **fields}
    )
    assert answer.status_code == 202, answer.text
    return answer.json()["id"]
