"""A run in the UI of a Prefect server that somebody looks at: progress, pages, the lines it logs.

On the private server of a run nobody can look, and nothing is sent. All is sent by a thread of its
own: a slow server does not slow the stages down, and one that fails costs the pages only.
"""

import contextlib
import logging
import queue
import threading
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Self
from uuid import UUID

from prefect import runtime
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.actions import ArtifactCreate, ArtifactUpdate
from prefect.context import TaskRunContext
from prefect.logging.handlers import APILogHandler
from prefect.settings import get_current_settings

from flows.pace import Pace
from flows.pages import PICTURE_BYTES, product_stages, run_page, stage_page
from flows.plan import Plan, Step
from flows.run_records import RunRecord, in_a_line
from flows.runs import in_short
from stages.base import Progress
from stages.store import Stored
from stages.thumbnails import thumbnails

log = logging.getLogger(__name__)

PROGRESS_EVERY_S = 5.0  # a stage that takes less shows no bar
LAST_PAGES_S = 15.0  # that the end of a run waits for what is still to be sent

Send = Callable[[SyncPrefectClient], None]


def is_watched() -> bool:
    """Whether the server is one that people look at: it is sent what is logged, then."""
    return get_current_settings().logging.to_api.enabled


class Showcase:
    """Shows one run for the length of a `with` block inside its flow; an observer of its stages.

    Args:
        plan: what is carried out.
        record: the run's page in the store, if it has one.
    """

    def __init__(self, plan: Plan, record: RunRecord | None) -> None:
        self._plan = plan
        self._record = record
        self._flow_run = UUID(str(runtime.flow_run.id))
        self._task_run: UUID | None = None
        self._artifacts: dict[str, Stored] = {}
        self._pace = Pace()
        self._progress: tuple[Progress, float | None] | None = None
        self._bar: UUID | None = None
        self._to_send: queue.Queue[Send | None] = queue.Queue()
        self._thread = threading.Thread(target=self._work, name="pages", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Add the page of the run as a whole, and wait until all is sent."""
        self._task_run = None
        line = "" if error is None else in_a_line(error)
        self._to_send.put(lambda client: self._show_run(client, line))
        self._to_send.put(None)
        self._thread.join(LAST_PAGES_S)

    @contextlib.contextmanager
    def logging_shown(self) -> Iterator[None]:
        """Let the lines of flows and stages show with the run, under the stage at work."""
        handler = APILogHandler(logging.INFO)
        handler.addFilter(self._place)
        loggers = logging.getLogger("flows"), logging.getLogger("stages")
        for logger in loggers:
            logger.addHandler(handler)
        try:
            yield
        finally:
            for logger in loggers:
                logger.removeHandler(handler)
            handler.flush()  # a worker of a batch ends without flushing anything

    def _place(self, record: logging.LogRecord) -> bool:
        """Say which run a line belongs to; it may come from any thread."""
        task = TaskRunContext.get()
        is_ours = task is not None and task.task_run.flow_run_id == self._flow_run
        record.flow_run_id = self._flow_run
        record.task_run_id = task.task_run.id if task and is_ours else self._task_run
        return True

    # What the run tells.

    def started(self, step: Step) -> None:
        """A stage begins to compute."""
        self._task_run = _task_run()

    def progressed(self, progress: Progress) -> None:
        """A stage has done some of its steps."""
        self._progress = progress, self._pace.left_s(progress)

    def failed(self, step: Step, error: BaseException) -> None:
        """A stage failed; it may be tried again."""

    def finished(self, step: Step, stored: Stored) -> None:
        """A stage's artifact is in the store."""
        task_run = _task_run()
        self._artifacts[step.node.name] = stored
        self._progress = self._task_run = None
        self._to_send.put(lambda client: self._show_stage(client, step, stored, task_run))

    # What the thread sends.

    def _work(self) -> None:
        try:
            with get_client(sync_client=True) as client:
                while (send := self._next()) is not None:
                    send(client)
        except Exception as error:
            log.warning("nothing more of this run is shown on Prefect's server: %s", error)

    def _next(self) -> Send | None:
        try:
            return self._to_send.get(timeout=PROGRESS_EVERY_S)
        except queue.Empty:
            return self._move_bar

    def _move_bar(self, client: SyncPrefectClient) -> None:
        """Show how far the stage at work is."""
        task_run = self._task_run
        if self._progress is None or task_run is None:
            return
        progress, left_s = self._progress
        terms = ", ".join(f"{name} {value:.4g}" for name, value in progress.terms.items())
        left = "" if left_s is None else f", {in_short(left_s)} left"
        about = f"{progress.stage}: {progress.step} of {progress.total}{left}. {terms}"
        self._set_bar(client, 100.0 * progress.step / max(1, progress.total), about, task_run)

    def _set_bar(
        self, client: SyncPrefectClient, percent: float, about: str, task_run: UUID
    ) -> None:
        if self._bar is not None:
            client.update_artifact(self._bar, ArtifactUpdate(data=percent, description=about))
            return
        bar = ArtifactCreate(
            key="progress",
            type="progress",
            data=percent,
            description=about,
            flow_run_id=self._flow_run,
            task_run_id=task_run,
        )
        self._bar = client.create_artifact(bar).id

    def _show_stage(
        self, client: SyncPrefectClient, step: Step, stored: Stored, task_run: UUID | None
    ) -> None:
        if self._bar is not None:
            about = f"{step.node.name}: done"
            client.update_artifact(self._bar, ArtifactUpdate(data=100.0, description=about))
            self._bar = None
        pictures = thumbnails(stored.folder, most_bytes=PICTURE_BYTES)
        about = f"{self._plan.source.stem}: {stored.manifest.record.get('headline', '')}"
        self._show(client, step.node.name, stage_page(stored, pictures), about, task_run)

    def _show_run(self, client: SyncPrefectClient, error: str) -> None:
        best = (self._artifacts[s] for s in product_stages(self._plan) if s in self._artifacts)
        shown = next(best, None)
        pictures = {} if shown is None else thumbnails(shown.folder, most_bytes=PICTURE_BYTES)
        page = run_page(self._plan, self._artifacts, pictures, self._record, error)
        told = error or f"{len(self._artifacts)} stages done"
        self._show(client, "run", page, f"{self._plan.source.stem}: {told}", None)

    def _show(
        self, client: SyncPrefectClient, name: str, page: str, about: str, task_run: UUID | None
    ) -> None:
        client.create_artifact(
            ArtifactCreate(
                # The pages of all runs about the same stage are found together.
                key=name.replace("_", "-"),
                type="markdown",
                data=page,
                description=about,
                flow_run_id=self._flow_run,
                task_run_id=task_run,
            )
        )


def _task_run() -> UUID | None:
    """The task that calls; None where a stage goes on without the engine."""
    task = TaskRunContext.get()
    return task.task_run.id if task else None
