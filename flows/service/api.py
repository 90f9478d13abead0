"""The endpoints."""

import importlib.metadata
import re
import time
from http import HTTPStatus
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, FastAPI, Form, Query, Request, Response
from fastapi import Path as InPath
from fastapi.responses import FileResponse

from flows.service.forms import HealthView, JobForm, JobPage, JobView, Report
from flows.service.gate import Gate
from flows.service.limits import ArchiveLimits
from flows.service.outcome import FILES, RUN, read_progress, read_report
from flows.service.problems import Problem, Refusal, answer_problems
from flows.service.queue import JobQueue
from flows.service.records import ID_PATTERN, Record
from flows.service.uploads import keep_picture, keep_views
from stages.store import FULL_DISK

ABOUT = """A photo of one object in, a relightable 3D asset out.

Send a picture with `POST /jobs`, ask `GET /jobs/{id}` until its `state` is `done`, then fetch
`GET /jobs/{id}/asset.glb`:

    curl -F picture=@shoe.png -F preset=preview http://127.0.0.1:8000/jobs

Whatever is refused is answered by one shape, `Problem`: what was wanted, what came, what to do.
"""
# A removed job's file must not be shown from a cache; one that is there need not be sent again.
ASKED_AGAIN = {"Cache-Control": "private, no-cache", "X-Content-Type-Options": "nosniff"}
MAX_PAGE = 100
ONE_RANGE = re.compile(r"bytes=(?:(\d{1,18})-(\d{0,18})|-(\d{1,18}))")
MEDIA_TYPES = {
    "asset.glb": "model/gltf-binary",
    "preview.png": "image/png",
    "views.png": "image/png",
}
MEANINGS = {
    400: "the request cannot be read",
    403: "the request is of another site's page",
    404: "there is no such job, or it has no such file",
    405: "the path does not know this method",
    408: "the request took too long to arrive",
    409: "the job is not done",
    413: "something is larger than it may be",
    415: "the upload is not of a kind that can be used",
    416: "the file is shorter than where the range begins",
    422: "a value does not fit",
    507: "the disk is full",
    503: "the queue is full; `Retry-After` says when to come back",
}

JobId = Annotated[
    str, InPath(pattern=ID_PATTERN, description="of a job", examples=["0f6f2d3c" * 4])
]


def _problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    return {status: {"model": Problem, "description": MEANINGS[status]} for status in statuses}


def make_app(queue: JobQueue, store: Path) -> FastAPI:
    """The service over a queue, which whoever serves it keeps at work.

    Args:
        queue: of its jobs.
        store: root folder of the store that runs use; tells how far they are.
    """
    app = FastAPI(title="svim3d", version=_version(), description=ABOUT)
    app.add_middleware(Gate, queue=queue)
    answer_problems(app)
    app.include_router(_Endpoints(queue, store).router())
    return app


def _version() -> str:
    try:
        return importlib.metadata.version("svim3d")
    except importlib.metadata.PackageNotFoundError:
        return "0"


class _Endpoints:
    """What is done for each path."""

    def __init__(self, queue: JobQueue, store: Path) -> None:
        self._queue = queue
        self._store = store

    def router(self) -> APIRouter:
        """All of them, with what each may answer."""
        router = APIRouter()
        add = router.add_api_route
        sent = _problems(400, 403, 408, 413, 415, 422, 503, 507)
        add("/jobs", self.send, methods=["POST"], status_code=202, responses=sent, tags=["jobs"])
        add("/jobs", self.page, methods=["GET"], responses=_problems(422), tags=["jobs"])
        found = _problems(404, 422)
        add("/jobs/{job}", self.show, methods=["GET"], responses=found, tags=["jobs"])
        add(
            "/jobs/{job}",
            self.cancel,
            methods=["DELETE"],
            responses=found | _problems(400, 403, 408, 413),
            tags=["jobs"],
        )
        fetched = found | _problems(409)
        add("/jobs/{job}/report", self.report, methods=["GET"], responses=fetched, tags=["results"])
        for name in FILES:
            add(
                f"/jobs/{{job}}/{name}",
                self._fetcher(name),
                methods=["GET"],
                responses=fetched
                | _problems(416)
                | {
                    200: {"content": {MEDIA_TYPES[name]: {}}, "description": "the file"},
                    206: {"content": {MEDIA_TYPES[name]: {}}, "description": "the range asked for"},
                    304: {"description": "the file is the one that `If-None-Match` names"},
                },
                response_class=FileResponse,
                name=name,
                summary=f"Fetch {name}",
                tags=["results"],
            )
        add("/health", self.health, methods=["GET"], tags=["service"])
        return router

    def send(
        self,
        form: Annotated[JobForm, Form(media_type="multipart/form-data")],
        request: Request,
        response: Response,
    ) -> JobView:
        """Send a picture, or views; the answer tells the job's id and where to ask for it."""
        if (form.picture is None) == (form.views is None):
            raise Refusal(
                HTTPStatus.UNPROCESSABLE_ENTITY,
                "no_input",
                wanted="either a picture or views",
                came="neither" if form.picture is None else "both",
                todo="send one of them, for example with curl -F picture=@photo.png",
            )

        def fill(job: str, folder: Path) -> Record:
            if form.picture is not None:
                name = keep_picture(form.picture.file, folder, self._queue.limits)
            else:
                assert form.views is not None
                name = keep_views(form.views.file, folder, ArchiveLimits())
            return Record(
                id=job,
                input=name,
                preset=form.preset,
                seed=form.seed,
                overrides=form.overrides(),
                skip=tuple(form.settings()["skip"]),
                settings=form.settings(),
                created=time.time(),
            )

        try:
            record = self._queue.submit(fill)
        except OSError as error:
            if error.errno not in FULL_DISK:
                raise
            raise Refusal(
                HTTPStatus.INSUFFICIENT_STORAGE,
                "disk_full",
                wanted="room for the upload",
                came="a full disk",
                todo="tell the operator; removing finished jobs makes some room",
            ) from error
        response.headers["Location"] = f"/jobs/{record.id}"
        return self._view(record)

    def page(
        self,
        limit: Annotated[int, Query(ge=1, le=MAX_PAGE, description="jobs on a page")] = 20,
        offset: Annotated[int, Query(ge=0, le=10**9, description="jobs before it")] = 0,
    ) -> JobPage:
        """List jobs, the newest first."""
        records = self._queue.newest()
        after = offset + limit
        return JobPage(
            jobs=[self._view(record) for record in records[offset:after]],
            total=len(records),
            next=after if after < len(records) else None,
        )

    def show(self, job: JobId) -> JobView:
        """Tell how a job stands."""
        return self._view(self._record(job))

    def cancel(self, job: JobId) -> JobView:
        """Cancel a job that waits or runs; remove one that has ended, with its files."""
        record = self._queue.cancel(job)
        if record is None:
            raise _no_such_job()
        return self._view(record)

    def report(self, job: JobId) -> Report:
        """Tell what the run did, stage by stage, and with which settings."""
        record = self._done(job)
        report = read_report(self._queue.folder(record))
        if report is None:
            raise _no_such_file()
        return Report.model_validate(report)

    def health(self) -> HealthView:
        """Tell that the service answers, and how much it has to do."""
        return HealthView(
            version=_version(),
            queued=self._queue.count("queued"),
            running=self._queue.count("running", "cancelling"),
            slots=self._queue.slots,
            queue=self._queue.limits.queue,
        )

    def _fetcher(self, name: str) -> Any:
        def fetch(job: JobId, request: Request) -> Response:
            record = self._done(job)
            return _send_file(self._queue.folder(record) / RUN / name, record, request)

        fetch.__doc__ = f"Fetch `{name}` of a job that is done, whole or in part (`Range`)."
        return fetch

    def _record(self, job: str) -> Record:
        record = self._queue.get(job)
        if record is None:
            raise _no_such_job()
        return record

    def _done(self, job: str) -> Record:
        record = self._record(job)
        if record.state != "done":
            raise Refusal(
                HTTPStatus.CONFLICT,
                "not_done",
                wanted="a job that is done",
                came=f"one that is {record.state}",
                todo="ask GET /jobs/{id} until its state is done"
                if record.is_active
                else "read its error with GET /jobs/{id}, then send the picture again",
            )
        return record

    def _view(self, record: Record) -> JobView:
        folder = self._queue.folder(record)
        is_done = record.state == "done"
        names = [name for name in FILES if is_done and (folder / RUN / name).is_file()]
        progress = None
        if record.started is not None and record.state != "queued":
            progress = read_progress(folder, self._store, since=record.started)
        return JobView.of(
            record,
            position=self._queue.position(record) if record.state == "queued" else None,
            progress=progress,
            files=[f"/jobs/{record.id}/{name}" for name in [*names, *(["report"] * is_done)]],
        )


def _send_file(file: Path, record: Record, request: Request) -> Response:
    """A file of a finished run, which never changes; whole, or the one range asked for."""
    try:
        state = file.stat()
    except OSError as error:
        raise _no_such_file() from error
    etag = f'"{state.st_mtime_ns:x}-{state.st_size:x}"'
    if request.headers.get("if-none-match") in (etag, f"W/{etag}", "*"):
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers={"ETag": etag})
    asked = request.headers.get("range")
    found = ONE_RANGE.fullmatch(asked) if asked is not None else None
    if found is not None and found[2] and int(found[2]) < int(found[1]):
        found = None
    if asked is not None and found is None:
        # Several ranges, or none that makes sense: the whole file answers both.
        request.scope["headers"] = [h for h in request.scope["headers"] if h[0] != b"range"]
    elif found is not None and (
        (found[1] and int(found[1]) >= state.st_size) or (found[3] and int(found[3]) == 0)
    ):
        raise Refusal(
            HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE,
            "no_such_range",
            wanted=f"a range within {state.st_size} bytes",
            came="one beyond",
            todo="begin nearer to the start, or ask for the whole file",
            headers={"Content-Range": f"bytes */{state.st_size}"},
        )
    return FileResponse(
        file,
        headers={"ETag": etag, **ASKED_AGAIN},
        media_type=MEDIA_TYPES[file.name],
        filename=f"{record.id[:8]}-{file.name}",
        stat_result=state,
    )


def _no_such_job() -> Refusal:
    return Refusal(
        HTTPStatus.NOT_FOUND,
        "no_such_job",
        wanted="the id of a job",
        came="one that no job has",
        todo="list the jobs with GET /jobs; finished ones are removed in time",
    )


def _no_such_file() -> Refusal:
    return Refusal(
        HTTPStatus.NOT_FOUND,
        "no_such_file",
        wanted="a file that the run has left",
        came="one that it has not",
        todo="GET /jobs/{id} lists its files; a skipped stage leaves none",
    )
