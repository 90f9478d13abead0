"""The flow of a batch: a task for each input, in it the input's own flow, by one of the runners."""

from collections.abc import Callable, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State
from prefect.context import hydrated_context, serialize_context
from prefect.exceptions import FailedRun
from prefect.futures import as_completed
from prefect.states import Completed, Failed
from prefect.task_runners import TaskRunner, ThreadPoolTaskRunner

from flows.batch_job import BatchJob, do_job
from flows.heartbeats import heartbeats_if_deployed
from flows.workers import Workers

Told = Callable[[BatchJob, float | BaseException], None]


@dataclass(frozen=True)
class Batch:
    """What the flow does.

    Attributes:
        jobs: one for each thing to compute.
        told: called with a job and its seconds, or what it failed of, as they come to their end.
        workers: that compute on this machine; None leaves it to the task runner.
    """

    jobs: Sequence[BatchJob]
    told: Told
    workers: Workers | None


# Context of a flow goes to every task: what it would carry as parameters would go a thousand times.
_batch: ContextVar[Batch] = ContextVar("batch")


def _the_batch() -> Batch:
    """The variable's value; flows and tasks are pickled with what they name, but for functions."""
    return _batch.get()


def make_runner(name: str, jobs: int, address: str | None) -> TaskRunner[Any]:
    """The task runner called `local`, `dask` or `ray`.

    Args:
        name: of the runner.
        jobs: inputs at a time, where the runner starts its own processes.
        address: of a cluster that runs already.
    """
    if name == "dask":
        from prefect_dask import DaskTaskRunner

        own = {"n_workers": jobs, "threads_per_worker": 1, "dashboard_address": None}
        given = {"address": address} if address else {"cluster_kwargs": own}
        return DaskTaskRunner(**given)
    if name == "ray":
        from prefect_ray import RayTaskRunner

        settings = {} if address else {"num_cpus": jobs, "include_dashboard": False}
        return RayTaskRunner(address=address, init_kwargs=settings)
    return ThreadPoolTaskRunner(max_workers=jobs)


def run_batch(batch: Batch, runner: TaskRunner[Any], name: str) -> None:
    """Carry a batch out; what its inputs come to is told, not raised.

    Raises:
        Exception: what kept the batch itself from going on.
    """
    token = _batch.set(batch)
    try:
        with heartbeats_if_deployed():
            batch_flow = _run_inputs.with_options(task_runner=runner, flow_run_name=name)
            state = batch_flow(inputs=len(batch.jobs), return_state=True)
            error = None if state.is_completed() else state.result(raise_on_failure=False)
            # Inputs that failed leave the state that was returned, other faults their exception.
            if isinstance(error, BaseException) and not isinstance(error, FailedRun):
                raise error
    finally:
        _batch.reset(token)


@task(cache_policy=NO_CACHE, persist_result=False)
def _in_worker(job: BatchJob) -> float:
    """Hand a job to a process of this machine, with the context that makes its flow a subflow."""
    workers = _the_batch().workers
    assert workers is not None
    context = serialize_context()
    seconds: float = workers.call(
        lambda lost: partial(_do_in_context, replace(job, lost_workers=lost), context)
    )
    return seconds


def _do_in_context(job: BatchJob, context: dict[str, Any]) -> float:
    with hydrated_context(context):
        return do_job(job)


@task(cache_policy=NO_CACHE, persist_result=False)
def _here(job: BatchJob) -> float:
    """Do a job where the task runner put it."""
    return do_job(job)


@flow(name="batch", persist_result=False, validate_parameters=False)
def _run_inputs(inputs: int) -> State[None]:
    batch = _the_batch()
    work = _here if batch.workers is None else _in_worker
    failures = 0
    try:
        futures = {}
        for job in batch.jobs:
            named = work.with_options(name=job.name, task_run_name=job.name)
            futures[named.submit(job)] = job
        for future in as_completed(list(futures)):
            outcome: float | Exception
            try:
                outcome = future.result()
            except Exception as error:
                failures += 1
                outcome = error
            batch.told(futures[future], outcome)
    except BaseException:
        if batch.workers is not None:
            batch.workers.stop()  # before the task runner waits for what they compute
        raise
    if failures:
        return Failed(message=f"{failures} of {inputs} inputs failed")
    return Completed(message=f"{inputs} inputs done")
