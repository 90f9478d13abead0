"""The tiny pipeline as a flow that can be deployed, like the real one's."""

from collections.abc import Sequence
from pathlib import Path

from prefect import flow
from tiny_pipeline import TINY, TinyConfig

from flows.batch_job import BatchJob
from flows.deployments import finish

HERE = Path(__file__).resolve().parent
PROJECT = HERE.parents[1]
ENTRYPOINT = f"{Path(__file__).stem}.make_tiny"
# What a worker's job needs to find it.
PYTHONPATH = f"{PROJECT}:{HERE}"


@flow(name="tiny", flow_run_name="{output}", persist_result=False)
def make_tiny(source: str, output: str, store: str, settings: Sequence[str] = ()):
    """Sum the numbers of a file after a walk."""
    return finish(
        lambda: BatchJob(
            name=Path(output).name,
            pipeline=TINY,
            schema=TinyConfig,
            source=Path(source),
            out=Path(output),
            preset="standard",
            overrides=tuple(settings),
            skip=frozenset(),
            seed=0,
            device="cpu",
            store=Path(store),
        )
    )
