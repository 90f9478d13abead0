"""A job on disk: its page, its input, its run folder and what its runs said.

jobs/<id>/job.json      what was asked for, how it stands; replaced in one step
jobs/<id>/photo.png     the input, or views/
jobs/<id>/run/          the run folder
jobs/<id>/log.txt       output of its runs
jobs/<id>/alive         locked while a run of it lives
incoming/<id>/          a job that is being received
"""

import os
import secrets
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field

PAGE = "job.json"
ID_BYTES = 16  # nobody guesses 128 random bits
ID_PATTERN = r"^[0-9a-f]{32}$"
MAX_EVENTS = 50  # a job that is stopped and resumed for ever must not grow for ever

State = Literal["queued", "running", "cancelling", "done", "failed", "cancelled"]
ACTIVE: frozenset[State] = frozenset({"queued", "running", "cancelling"})


class Event(BaseModel):
    """Something that happened to a job."""

    at: float = Field(description="seconds since 1970")
    message: str


class Record(BaseModel):
    """A job, as it is kept.

    Attributes:
        id: a random token of ours.
        input: name of the photo or the folder of views, in the job's folder.
        preset: of settings.
        seed: of all random numbers.
        overrides: settings, as `--set` wants them.
        skip: stages to leave out.
        settings: what the caller asked for, to be shown.
        starts: how often a run of it was started and not stopped by the service itself.
        pid: of the last run, which leads a process group.
        error: how it failed, in a line.
    """

    model_config = ConfigDict(validate_assignment=True)

    id: str = Field(pattern=ID_PATTERN)
    input: str
    preset: str
    seed: int = 0
    overrides: tuple[str, ...] = ()
    skip: tuple[str, ...] = ()
    settings: dict[str, Any] = {}
    state: State = "queued"
    created: float
    started: float | None = None
    finished: float | None = None
    starts: int = 0
    pid: int | None = None
    error: str | None = None
    events: list[Event] = []

    @property
    def is_active(self) -> bool:
        """Whether something is still to happen to it."""
        return self.state in ACTIVE

    def note(self, at: float, message: str) -> None:
        """Remember an event."""
        self.events = [*self.events, Event(at=at, message=message)][-MAX_EVENTS:]

    def write(self, folder: Path) -> None:
        """Replace the page in `folder`: after a crash the old one is there, or the new one."""
        partial = folder / f".{PAGE}.{os.getpid()}"
        with partial.open("w") as file:
            file.write(self.model_dump_json(indent=1))
            file.flush()
            os.fsync(file.fileno())
        partial.replace(folder / PAGE)

    @classmethod
    def read(cls, folder: Path) -> Self:
        """The page in `folder`.

        Raises:
            OSError: there is none.
            ValueError: it is damaged.
        """
        record = cls.model_validate_json((folder / PAGE).read_bytes())
        if record.id != folder.name:
            raise ValueError(f"the page in {folder} is of another job")
        return record


def new_id() -> str:
    """A token that nobody can guess, of characters that mean nothing to any file system."""
    return secrets.token_hex(ID_BYTES)
