"""The service over a tiny script, without its extra no test of it."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

pytest.importorskip("fastapi")
pytest.importorskip("python_multipart")

from fake_service import command
from fastapi.testclient import TestClient

from flows.service.api import make_app
from flows.service.limits import Limits
from flows.service.queue import JobQueue


@pytest.fixture
def home(tmp_path: Path) -> Path:
    return tmp_path / "store" / "service"


@pytest.fixture
def serving(home: Path) -> Callable[..., contextlib.AbstractContextManager[TestClient]]:
    """`with serving(slots=1, queue=3) as client`: the service, for as long as the block takes."""

    @contextlib.contextmanager
    def serve(*, slots: int = 1, **limits) -> Iterator[TestClient]:
        queue = JobQueue(home, command, Limits(**limits), slots=slots)
        app = make_app(queue, home.parent)
        with queue, TestClient(app, raise_server_exceptions=False) as client:
            yield client

    return serve


@pytest.fixture
def client(serving) -> Iterator[TestClient]:
    with serving() as client:
        yield client
