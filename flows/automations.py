"""What keeps deployed runs going when nobody looks: rules that the Prefect server follows.

A killed job is noticed by the worker that started it. Where that died too, a run would be called
running for ever: the first two rules call it crashed. The others start the flow `resume` of
`flows.deployments`, which gives crashed runs further tries and counts them: Prefect's own action
for a crash knows no end. A loaded server loses events, so that flow looks at all crashed runs,
whichever event it was started by, and its schedule starts it where the event was lost.
"""

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from uuid import UUID

import httpx
from prefect.automations import (
    AutomationCore,
    ChangeFlowRunState,
    EventTrigger,
    Posture,
    ResourceSpecification,
    RunDeployment,
)
from prefect.client.orchestration import SyncPrefectClient, get_client
from prefect.client.schemas.filters import (
    DeploymentFilter,
    DeploymentFilterTags,
    FlowFilter,
    FlowFilterName,
    FlowRunFilter,
    FlowRunFilterDeploymentId,
    FlowRunFilterExpectedStartTime,
    FlowRunFilterState,
    FlowRunFilterStateType,
    FlowRunFilterTags,
)
from prefect.client.schemas.objects import FlowRun, State, StateType
from prefect.settings import PREFECT_API_URL
from prefect.states import AwaitingRetry, Failed
from rich.console import Console

from stages.errors import InputError

TAG = "svim3d"  # of deployments and of all that runs inside of them
RESUME = "resume"  # the flow that looks at crashed runs
RESUME_CRON = "*/5 * * * *"  # where the event of a crash was lost
HEARTBEAT_S = 30  # the least that Prefect allows; prefect.yaml and `svim3d serve` set it
SILENT_S = 120  # four heartbeats; a busy server takes events up to 15 s late
# A process imports torch and Prefect before its run is running: 5 to 30 s on a loaded machine.
STARTING_S = 600
DEFAULT_ATTEMPTS = 3
PAUSE_S = 10.0  # before the first further try, twice that before each next one
HEARTBEAT, ANY = "prefect.flow-run.heartbeat", "prefect.flow-run.*"


@dataclass(frozen=True)
class Verdict:
    """What a run should come to.

    Attributes:
        state: the next one; None leaves the run alone.
        reason: in words.
    """

    state: State[None] | None
    reason: str


def judge(run: FlowRun, states: Iterable[State], attempts: int) -> Verdict:
    """Whether a run gets another try.

    Args:
        run: as it is now.
        states: all that it was in.
        attempts: tries after the first.
    """
    if run.state is None or not run.state.is_crashed():
        return Verdict(None, "left alone: it is not crashed")
    if run.deployment_id is None:
        return Verdict(None, "left alone: it is part of another run")
    # Not the number of starts: what crashes before it runs would be tried for ever.
    crashes = sum(state.is_crashed() for state in states)
    if crashes > attempts:
        reason = f"crashed {crashes} times and was given up; the last time: {run.state.message}"
        return Verdict(Failed(message=reason), reason)
    pause_s = PAUSE_S * 2 ** (crashes - 1)
    reason = f"crashed; further try {crashes} of {attempts} in {pause_s:g} s"
    when = datetime.now(UTC) + timedelta(seconds=pause_s)
    return Verdict(AwaitingRetry(scheduled_time=when, message=reason), reason)


def crashed_runs(client: SyncPrefectClient, hours: float) -> list[FlowRun]:
    """Runs of our deployments that are crashed; older ones are left to people.

    Args:
        client: of the server.
        hours: since they were to start.
    """
    return client.read_flow_runs(
        flow_run_filter=FlowRunFilter(
            tags=FlowRunFilterTags(all_=[TAG]),
            deployment_id=FlowRunFilterDeploymentId(is_null_=False),
            state=FlowRunFilterState(type=FlowRunFilterStateType(any_=[StateType.CRASHED])),
            expected_start_time=FlowRunFilterExpectedStartTime(
                after_=datetime.now(UTC) - timedelta(hours=hours)
            ),
        )
    )


def zombie_rules(silent_s: float = SILENT_S) -> list[AutomationCore]:
    """Rules that call runs crashed which nobody computes any more.

    Args:
        silent_s: without a heartbeat, after which a run is taken for dead.
    """

    def crash(name: str, after: str, within_s: float, message: str) -> AutomationCore:
        return AutomationCore(
            name=name,
            description=message,
            trigger=EventTrigger(
                after={after},
                # Any word of the run will do; after its last one no heartbeat starts the clock.
                expect={ANY},
                match=ResourceSpecification({"prefect.resource.id": ANY}),
                match_related=ResourceSpecification(
                    {"prefect.resource.role": "tag", "prefect.resource.id": f"prefect.tag.{TAG}"}
                ),
                for_each={"prefect.resource.id"},
                posture=Posture.Proactive,
                within=timedelta(seconds=within_s),
            ),
            actions=[ChangeFlowRunState(state=StateType.CRASHED, message=message)],
        )

    return [
        crash("svim3d: silent runs", HEARTBEAT, silent_s, f"no heartbeat for {silent_s:g} s"),
        crash(
            "svim3d: runs that never start",
            "prefect.flow-run.Pending",
            STARTING_S,
            f"not running {STARTING_S} s after a worker took it",
        ),
    ]


def resume_rule(name: str, resume: UUID, watched: Sequence[UUID]) -> AutomationCore:
    """The rule that has crashed runs looked at, at once.

    Args:
        name: of the deployments.
        resume: the deployment of the flow that looks.
        watched: deployments whose crashes start it; never itself, or its crashes had no end.
    """
    return AutomationCore(
        name=f"svim3d: crashed runs of {name}",
        description="starts the flow that gives crashed runs further tries",
        trigger=EventTrigger(
            expect={"prefect.flow-run.Crashed"},
            match=ResourceSpecification({"prefect.resource.id": ANY}),
            match_related=ResourceSpecification(
                {
                    "prefect.resource.role": "deployment",
                    "prefect.resource.id": sorted(f"prefect.deployment.{id_}" for id_ in watched),
                }
            ),
            for_each={"prefect.resource.id"},
            posture=Posture.Reactive,
            threshold=1,
        ),
        actions=[RunDeployment(source="selected", deployment_id=resume)],
    )


def register(client: SyncPrefectClient, silent_s: float = SILENT_S) -> dict[str, str]:
    """Make the server follow the rules, for all deployments that carry the tag.

    What is there already stays, also where somebody has switched it off.

    Returns:
        What became of each rule, by name.
    """
    rules = zombie_rules(silent_s)
    ours = DeploymentFilter(tags=DeploymentFilterTags(all_=[TAG]))
    all_ids: dict[str, list[UUID]] = {}
    for deployment in client.read_deployments(deployment_filter=ours):
        all_ids.setdefault(deployment.name, []).append(deployment.id)
    resumes = client.read_deployments(
        flow_filter=FlowFilter(name=FlowFilterName(any_=[RESUME])), deployment_filter=ours
    )
    for resume in sorted(resumes, key=lambda deployment: deployment.name):
        watched = [id_ for id_ in all_ids[resume.name] if id_ != resume.id]
        if watched:
            rules.append(resume_rule(resume.name, resume.id, watched))
    return {rule.name: _put(client, rule) for rule in rules}


def _put(client: SyncPrefectClient, rule: AutomationCore) -> str:
    for there in client.read_automations_by_name(rule.name):
        wanted = rule.model_copy(update={"enabled": there.enabled})
        if _definition(there) == _definition(wanted):
            return "stays"
        client.update_automation(there.id, wanted)
        return "changed"
    client.create_automation(rule)
    return "made"


def _definition(rule: AutomationCore) -> dict[str, object]:
    """What makes two rules the same, whichever of them comes from the server."""
    return AutomationCore.model_validate(rule.model_dump()).model_dump(
        mode="json", exclude={"id", "owner_resource", "tags"}
    )


def require_server() -> str:
    """Address of the Prefect server that deployments need.

    Raises:
        InputError: there is none.
    """
    url = PREFECT_API_URL.value()
    todo = (
        "start one with `prefect server start`, then say "
        "`export PREFECT_API_URL=http://127.0.0.1:4200/api`"
    )
    if not url:
        raise InputError(f"deployments need a Prefect server, and none is named; {todo}")
    try:
        with get_client(sync_client=True) as client:
            fault = client.api_healthcheck()
    except httpx.HTTPError as error:
        fault = error
    if fault is not None:
        raise InputError(f"the Prefect server at {url} does not answer ({fault}); {todo}")
    return url


def automations(options: argparse.Namespace) -> int:
    """Register the rules with the server; see `svim3d automations --help`."""
    url = require_server()
    with get_client(sync_client=True) as client:
        outcome = register(client)
    tell(outcome, url)
    return 0


def tell(outcome: dict[str, str], url: str) -> None:
    """Print what became of the rules."""
    console = Console()
    for name, what in outcome.items():
        console.print(f"{what}: {name}", highlight=False, markup=False)
    if len(outcome) == len(zombie_rules()):
        console.print(
            f"no deployment of ours is at {url}, so crashed runs are not resumed; "
            "prefect deploy --all, then once more",
            style="yellow",
            highlight=False,
            markup=False,
        )
