"""Flows that are deployed: one input, many inputs, and what a crashed run comes to.

A work pool runs them as prefect.yaml says, `svim3d serve` runs them from this machine. Prefect
makes a form of their signatures and refuses what does not fit them before a run is made; the rest
is checked as on the command line, whose options have the same names. A run is a job of a batch: the
same store, the same page for `svim3d status`, the same answer from the store when it is there.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal

from prefect import flow, get_run_logger, runtime, tags
from prefect.client.orchestration import get_client
from prefect.client.schemas.objects import State
from prefect.states import Completed, Failed
from pydantic import Field

from flows.automations import DEFAULT_ATTEMPTS, RESUME, TAG, crashed_runs, judge
from flows.batch import ALL_DONE, carry_out
from flows.batch_job import BatchJob, JobError, do_job
from flows.batch_options import batch_options
from flows.batch_results import RESULTS
from flows.commands import input_path
from flows.config import PipelineConfig
from flows.limits import parse_limits
from flows.pipeline import IMAGE_TO_ASSET
from stages.errors import InputError

# A worker's folder is none that anybody chose, so paths are whole; other schemes are no files.
PATH = r"^/[^\x00]*$"
Folder = Annotated[str, Field(pattern=PATH)]
Input = Annotated[str, Field(pattern=rf"{PATH}|^(example|photo)$")]
Preset = Literal["preview", "standard", "paper", "auto"]
Skippable = Literal["capacity", "env_preopt", "dmtet", "uv_bake", "preview"]
Device = Literal["auto", "cpu", "cuda"]
Setting = Annotated[str, Field(pattern=r"^\s*[a-z][a-z0-9_.]*\s*=")]
Limit = Annotated[str, Field(pattern=r"^([a-z_]+=)?[0-9.]+$")]
Share = Annotated[str, Field(pattern=r"^[a-z0-9+]+://")]
Count = Annotated[int, Field(ge=1, le=256)]
Hours = Annotated[float, Field(gt=0.0)]
Inputs = Annotated[list[Input], Field(min_length=1)]


def _named_by(*names: str) -> Callable[[], str]:
    """A name for a run out of its parameters; of paths the last part."""

    def name() -> str:
        given = runtime.flow_run.parameters
        return "-".join(str(given[n]).rstrip("/").rpartition("/")[2] for n in names)

    return name


@flow(name="asset", flow_run_name=_named_by("output", "preset"), persist_result=False)
def make_asset(
    source: Input,
    output: Folder,
    store: Folder,
    preset: Preset = "standard",
    settings: Sequence[Setting] = (),
    skip: Sequence[Skippable] = (),
    timeout: Sequence[Limit] = (),
    seed: int = 0,
    device: Device = "auto",
    share: Share | None = None,
) -> State[None]:
    """Make the asset of one input, or find it made.

    Args:
        source: Whole path of a photo, an orbit folder, a mesh or a scene file on the worker's
            machine, or one of the words photo and example.
        output: Run folder; is made.
        store: Folder of the artifacts; runs that share it share what they compute.
        preset: From quick to thorough.
        settings: Single changes of the preset, like nerf.steps=500.
        skip: Stages to leave out.
        timeout: Seconds after which a stage is stopped, like 600 or nerf=600.
        seed: Of all random numbers.
        device: Where to compute; on a GPU one stage at a time.
        share: URL of a store that machines share, like s3://bucket/store.
    """
    return finish(
        lambda: BatchJob(
            name=Path(output).name,
            pipeline=IMAGE_TO_ASSET,
            schema=PipelineConfig,
            source=input_path(source),
            out=Path(output),
            preset=preset,
            overrides=tuple(settings),
            skip=frozenset(skip),
            seed=seed,
            device=device,
            store=Path(store),
            limits_s=parse_limits(timeout, IMAGE_TO_ASSET.names),
            share=share,
        )
    )


def finish(make: Callable[[], BatchJob]) -> State[None]:
    """Carry a job out inside a deployed flow; the state that the flow returns.

    What a job fails of is a failed run, which nobody tries again: stages have been tried as often
    as their fault allows. Only a run that was killed is a crashed one.

    Args:
        make: gives the job.
    """
    try:
        job = make()
        with tags(TAG):  # flows inside of a flow do not inherit them
            seconds = do_job(job)
    except JobError as error:
        at = f"{error.stage}: " if error.stage else ""
        return Failed(message=f"{at}{error.message}")
    except InputError as error:
        return Failed(message=str(error))
    return Completed(message=f"{job.out} after {seconds:.1f} s")


@flow(name="assets", flow_run_name=_named_by("output", "preset"), persist_result=False)
def make_assets(
    inputs: Inputs,
    output: Folder,
    store: Folder,
    preset: Preset = "standard",
    settings: Sequence[Setting] = (),
    skip: Sequence[Skippable] = (),
    timeout: Sequence[Limit] = (),
    seed: int = 0,
    device: Device = "auto",
    share: Share | None = None,
    jobs: Count = 1,
) -> State[None]:
    """Make the assets of many inputs on one machine, a table of them, and stop for none.

    Args:
        inputs: Whole paths of manifests (.csv, .jsonl), folders, inputs, or patterns like
            /in/*.png, on the worker's machine.
        output: Folder for results.csv and a run folder for each input.
        store: Folder of the artifacts; runs that share it share what they compute.
        preset: From quick to thorough.
        settings: Single changes of the preset, like nerf.steps=500.
        skip: Stages to leave out.
        timeout: Seconds after which a stage is stopped, like 600 or nerf=600.
        seed: Of all random numbers.
        device: Where to compute; on a GPU one stage at a time.
        share: URL of a store that machines share, like s3://bucket/store.
        jobs: Inputs at a time; cores are shared out.
    """
    options = batch_options().parse_args(
        [
            *(*inputs, "--output", output, "--preset", preset, "--device", device),
            *("--seed", str(seed), "--jobs", str(jobs)),
            *(f"--set={setting}" for setting in settings),
            *(f"--skip={stage}" for stage in skip),
            *(f"--timeout={limit}" for limit in timeout),
            *((f"--share={share}",) if share else ()),
        ]
    )
    options.store = Path(store)
    try:
        with tags(TAG):
            code = carry_out(options)
    except InputError as error:
        return Failed(message=str(error))
    table = Path(output) / RESULTS
    return Completed(message=str(table)) if code == ALL_DONE else Failed(message=f"see {table}")


@flow(name=RESUME, persist_result=False)
def resume_crashed(attempts: Count = DEFAULT_ATTEMPTS, hours: Hours = 24.0) -> State[None]:
    """Give runs that crashed further tries, up to so many; the automations call it.

    Args:
        attempts: Further tries that a run gets; after them it is failed.
        hours: How old a run may be; what was to start earlier is left to people.
    """
    said = get_run_logger()
    again = given_up = 0
    with get_client(sync_client=True) as client:
        for run in crashed_runs(client, hours):
            # Read anew: another look may have come to the same run in the meantime.
            now = client.read_flow_run(run.id)
            verdict = judge(now, client.read_flow_run_states(run.id), attempts)
            said.info("%s (%s): %s", run.name, run.id, verdict.reason)
            if verdict.state is not None:
                client.set_flow_run_state(run.id, verdict.state, force=True)
                again += verdict.state.is_scheduled()
                given_up += verdict.state.is_failed()
    return Completed(message=f"{again} runs get another try, {given_up} were given up")
