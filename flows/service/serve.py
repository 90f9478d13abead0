"""`svim3d serve --http`: the service as a process."""

import argparse
import contextlib
import sys
from pathlib import Path

import uvicorn

from flows.service.api import make_app
from flows.service.child import run_command
from flows.service.limits import MIB, Limits
from flows.service.outcome import RUN
from flows.service.queue import STOP_GRACE_S, JobQueue
from flows.service.records import Record
from flows.stopping import interrupt_on_stop

FOLDER = "service"  # in the store, so that its disk is the only one to watch
DONE = 0
HOUR_S = 3600.0


def serve(options: argparse.Namespace) -> int:
    """Answer requests until stopped; jobs at work then wait for the next start."""
    store = options.store.resolve()
    limits = Limits(
        upload_bytes=round(options.max_upload_mib * MIB),
        queue=options.queue,
        timeout_s=options.timeout_h * HOUR_S,
        keep_s=options.keep_h * HOUR_S,
    )

    def command(record: Record, folder: Path) -> list[str]:
        return run_command(
            folder / record.input,
            folder / RUN,
            store=store,
            device=options.device,
            options=run_options(record),
        )

    queue = JobQueue(store / FOLDER, command, limits, slots=options.jobs)
    config = uvicorn.Config(
        make_app(queue, store),
        host=options.host,
        port=options.port,
        log_level="warning",
        server_header=False,
        timeout_graceful_shutdown=round(STOP_GRACE_S),
    )
    # The server hands a stop on once it has ended; without this the queue would not hear of it.
    interrupt_on_stop()
    with queue, contextlib.suppress(KeyboardInterrupt):
        print(
            f"svim3d: http://{options.host}:{options.port}/docs, {options.jobs} at a time, "
            f"jobs in {store / FOLDER}",
            file=sys.stderr,
        )
        uvicorn.Server(config).run()
    return DONE


def run_options(record: Record) -> list[str]:
    """What a job adds to the command of its run."""
    return [
        *("--preset", record.preset),
        *("--seed", str(record.seed)),
        *(word for override in record.overrides for word in ("--set", override)),
        *(word for stage in record.skip for word in ("--skip", stage)),
    ]
