"""A tiny pipeline with an input and a store; the Prefect engine, once for all tests."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from flows.engine import Engine
from stages.store import Store


@pytest.fixture
def source(tmp_path: Path) -> Path:
    file = tmp_path / "input" / "digits.txt"
    file.parent.mkdir()
    file.write_text("1 2 3")
    return file


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store", say=lambda _: None)


@pytest.fixture(scope="session")
def engine(tmp_path_factory) -> Iterator[Engine]:
    """The engine of a run, kept for the session: its settings are read when Prefect is imported."""
    with Engine(tmp_path_factory.mktemp("home") / "missing" / "parents") as engine:
        engine.wait()
        yield engine
