"""How the service says no: one shape of answer, in words, and nothing about the machine."""

import logging
import re
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field
from starlette.exceptions import HTTPException

log = logging.getLogger(__name__)

# A path from the root, with at least one folder: `/tmp/x.png`, but neither `1/2` nor `/jobs`.
MACHINE_PATH = re.compile(r"(?<![\w./:])(?:/[^\s/:;,'\"()\[\]]+)+/([^\s/:;,'\"()\[\]]*)")
MAX_ECHO = 80  # characters of a caller's own words that an answer repeats


class Problem(BaseModel):
    """Why a request was not carried out."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "code": "no_such_job",
                    "wanted": "the id of a job",
                    "came": "one that no job has",
                    "todo": "list the jobs with GET /jobs; finished ones are removed in time",
                }
            ]
        }
    )

    code: str = Field(description="for programs; never changes its meaning")
    wanted: str = Field(description="what would have been right")
    came: str = Field(description="what was there instead")
    todo: str = Field(description="what to do about it")


class Refusal(HTTPException):
    """A request that is not carried out; becomes a `Problem`."""

    def __init__(
        self,
        status: HTTPStatus,
        code: str,
        *,
        wanted: str,
        came: str,
        todo: str,
        headers: dict[str, str] | None = None,
    ) -> None:
        self.problem = Problem(code=code, wanted=wanted, came=came, todo=todo)
        super().__init__(status, detail=code, headers=headers)


def without_paths(text: str) -> str:
    """A message with each path of the machine cut down to its last name."""
    return MACHINE_PATH.sub(lambda found: found[1] or "a folder", text)


def strip_paths(value: Any) -> Any:
    """The same for every text in nested lists and dictionaries."""
    if isinstance(value, str):
        return without_paths(value)
    if isinstance(value, dict):
        return {without_paths(str(name)): strip_paths(below) for name, below in value.items()}
    return [strip_paths(below) for below in value] if isinstance(value, list) else value


def answer(status: int, problem: Problem, headers: dict[str, str] | None = None) -> JSONResponse:
    """A problem as a response."""
    return JSONResponse(problem.model_dump(), status, headers)


def answer_problems(app: FastAPI) -> None:
    """Give whatever goes wrong the one shape."""
    app.add_exception_handler(HTTPException, _refused)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(Exception, _defect)


async def _refused(request: Request, error: Exception) -> JSONResponse:
    """A refusal of ours, or what the framework refuses: unknown paths, methods, broken forms."""
    if isinstance(error, Refusal):
        return answer(error.status_code, error.problem, dict(error.headers or {}))
    assert isinstance(error, HTTPException)
    problem = {
        HTTPStatus.NOT_FOUND: Problem(
            code="no_such_page",
            wanted="one of the paths that /docs lists",
            came="another one",
            todo="read /docs",
        ),
        HTTPStatus.METHOD_NOT_ALLOWED: Problem(
            code="no_such_method",
            wanted="a method that this path knows",
            came=_echo(request.method),
            todo="read /docs",
        ),
    }.get(HTTPStatus(error.status_code)) or Problem(
        code="broken_request",
        wanted="a multipart form as /docs describes it",
        came=_echo(str(error.detail)),
        todo="send it anew, for example with curl -F picture=@photo.png",
    )
    return answer(error.status_code, problem, dict(error.headers or {}))


async def _invalid(request: Request, error: Exception) -> JSONResponse:
    """Values that do not fit; names the first, counts the others."""
    assert isinstance(error, RequestValidationError)
    faults = error.errors()
    first = faults[0]
    place = ".".join(str(part) for part in first["loc"][1:]) or "the request"
    more = f", and {len(faults) - 1} more" if len(faults) > 1 else ""
    # An upload in a text field, or the reverse, has no value worth repeating.
    given = first.get("input")
    came = _echo(repr(given)) if isinstance(given, str | int | float) else "none that fits"
    if first["type"] == "extra_forbidden":
        wanted = "fields that /docs lists"
    else:
        wanted = _echo(str(first["msg"])[:1].lower() + str(first["msg"])[1:])
    problem = Problem(
        code="invalid_value",
        wanted=f"{_echo(place)}: {wanted}",
        came=f"{came}{more}",
        todo="correct it; /docs lists all fields with their bounds",
    )
    return answer(HTTPStatus.UNPROCESSABLE_ENTITY, problem)


async def _defect(request: Request, error: Exception) -> JSONResponse:
    """A fault of ours: told to the log, not to the caller."""
    log.error("a request failed", exc_info=error)
    problem = Problem(
        code="defect",
        wanted="to carry this request out",
        came="a fault inside the service",
        todo="try again; the log of the service tells its operator more",
    )
    return answer(HTTPStatus.INTERNAL_SERVER_ERROR, problem)


def _echo(text: str) -> str:
    """A caller's words, short, on one line and in plain characters."""
    plain = without_paths("".join(c if c.isprintable() else "?" for c in text))
    return plain if len(plain) <= MAX_ECHO else f"{plain[:MAX_ECHO]}..."
