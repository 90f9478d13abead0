"""The service over a tiny script. Without the extra `http` there is nothing to test."""

import contextlib
import importlib.util
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest


def lacks(*names: str) -> bool:
    return any(importlib.util.find_spec(name) is None for name in names)


collect_ignore_glob = ["*"] if lacks("fastapi", "uvicorn", "python_multipart") else []
collect_ignore = ["test_fuzz.py"] if lacks("schemathesis", "hypothesis") else []


@pytest.fixture
def home(tmp_path: Path) -> Path:
    return tmp_path / "store" / "service"


@pytest.fixture
def serving(home: Path) -> Callable[..., contextlib.AbstractContextManager]:
    """`with serving(slots=1, queue=3) as client`: the service, for as long as the block takes."""
    from fake_service import command
    from fastapi.testclient import TestClient

    from flows.service.api import make_app
    from flows.service.limits import Limits
    from flows.service.queue import JobQueue

    @contextlib.contextmanager
    def serve(*, slots: int = 1, **limits) -> Iterator[TestClient]:
        queue = JobQueue(home, command, Limits(**limits), slots=slots)
        app = make_app(queue, home.parent)
        with queue, TestClient(app, raise_server_exceptions=False) as client:
            yield client

    return serve


@pytest.fixture
def client(serving) -> Iterator:
    with serving() as client:
        yield client
