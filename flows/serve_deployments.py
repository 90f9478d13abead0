"""`svim3d serve`: runs of the deployments, carried out by this machine without a work pool."""

import argparse
import asyncio
import signal
from pathlib import Path

from prefect.client.orchestration import get_client
from prefect.deployments.runner import RunnerDeployment
from prefect.exceptions import TerminationSignal
from prefect.runner import Runner
from prefect.types.entrypoint import EntrypointType
from rich.console import Console

from flows.automations import HEARTBEAT_S, RESUME_CRON, TAG, register, require_server, tell
from flows.deployments import make_asset, make_assets, resume_crashed

NAME = "served"
STOPPED = 130


def serve_deployments(options: argparse.Namespace) -> int:
    """Register deployments and automations, then do what the server has to be done.

    Raises:
        InputError: no server is there.
    """
    url = require_server()
    runner = Runner(name=NAME, limit=options.jobs, heartbeat_seconds=HEARTBEAT_S)
    settings = {"store": str(Path(options.store).resolve()), "device": options.device}
    for served, parameters, cron in (
        (make_asset, settings, None),
        (make_assets, settings, None),
        (resume_crashed, {}, RESUME_CRON),
    ):
        runner.add_deployment(
            RunnerDeployment.from_flow(
                served,
                NAME,
                tags=[TAG],
                parameters=parameters,
                cron=cron,
                entrypoint_type=EntrypointType.MODULE_PATH,
            )
        )
    with get_client(sync_client=True) as client:
        tell(register(client), url)
    names = f"{make_asset.name}/{NAME} and {make_assets.name}/{NAME}"
    Console().print(
        f"serving {names} to {url}, {options.jobs} at a time; Ctrl-C ends it",
        highlight=False,
    )
    # A shell starts background jobs with interrupts ignored, and the runner could not be stopped.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        asyncio.run(runner.start())
    except (KeyboardInterrupt, TerminationSignal):
        return STOPPED
    return 0
