"""Signs of life, for the runs that somebody watches."""

import contextlib
import os
from collections.abc import Iterator

from prefect.settings import PREFECT_FLOWS_HEARTBEAT_FREQUENCY, temporary_settings

# Prefect tells a job's process, and with it all its children, which run of a deployment it is for.
DEPLOYED_RUN = "PREFECT__FLOW_RUN_ID"


@contextlib.contextmanager
def heartbeats_if_deployed() -> Iterator[None]:
    """Let flows in the block send heartbeats if they belong to a deployment's run.

    There they tell its zombies. Elsewhere nobody asks for them, and joining the thread that sends
    them makes the end of each flow a second late.
    """
    if DEPLOYED_RUN in os.environ:
        yield
        return
    with temporary_settings({PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}):
        yield
