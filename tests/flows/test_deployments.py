"""Deployed flows: forms, what they refuse, the same run as on the command line, further tries."""

import importlib
import re
import typing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from uuid import uuid4

import pytest
import yaml
from tiny_batch import TINY_FILES, TinyConfig
from tiny_runs import plan_tiny

from flows import cli
from flows.config import PRESETS
from flows.options import job_options
from flows.pipeline import IMAGE_TO_ASSET
from flows.recording import RunRecorder
from flows.run_records import CANCELLED, DONE, RunIndex

PROJECT = Path(__file__).resolve().parents[2]
DEPLOYED = ("make_asset", "make_assets", "resume_crashed")

pytestmark = pytest.mark.flow


@pytest.fixture(scope="module")
def deployments(engine):
    return importlib.import_module("flows.deployments")


@pytest.fixture(scope="module")
def make_tiny(engine):
    return importlib.import_module("tiny_deployment").make_tiny


@pytest.fixture(scope="module")
def automations(engine):
    return importlib.import_module("flows.automations")


def form(deployed) -> dict:
    return deployed.parameters.model_dump()["properties"]


@pytest.mark.parametrize("name", DEPLOYED)
def test_every_parameter_is_explained_in_the_form(deployments, name):
    for parameter, field in form(getattr(deployments, name)).items():
        assert field["title"] == parameter
        assert field["description"][0].isupper() and field["description"].endswith(".")


def test_choices_are_those_of_the_program(deployments):
    assert typing.get_args(deployments.Preset) == PRESETS
    assert typing.get_args(deployments.Skippable) == IMAGE_TO_ASSET.skippable
    (device,) = (a for a in job_options()._actions if a.dest == "device")
    assert typing.get_args(deployments.Device) == tuple(device.choices)
    for deployed in (deployments.make_asset, deployments.make_assets):
        fields = form(deployed)
        assert fields["preset"]["enum"] == list(PRESETS)
        assert fields["skip"]["items"]["enum"] == list(IMAGE_TO_ASSET.skippable)
        defaults = {action.dest: action.default for action in job_options()._actions}
        for option in ("preset", "seed", "device", "share"):
            assert fields[option]["default"] == defaults[option]


GOOD = {"source": "/in/shoe.png", "output": "/out/shoe", "store": "/store"}


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"source": "photo"},
        {"source": "example", "settings": ["nerf.steps=500", "skip=[]"], "timeout": ["60"]},
        {"skip": ["dmtet"], "timeout": ["nerf=600", "30.5"], "share": "s3://bucket/store"},
    ],
)
def test_what_fits_the_form_is_taken(deployments, given):
    assert deployments.make_asset.validate_parameters(GOOD | given)


@pytest.mark.parametrize(
    "given",
    [
        {"source": "shoe.png"},
        {"source": "https://example.org/shoe.png"},
        {"output": "out"},
        {"store": "file:///store"},
        {"preset": "best"},
        {"settings": ["nerf.steps"]},
        {"settings": "nerf.steps=5"},
        {"skip": ["nerf"]},
        {"timeout": ["soon"]},
        {"device": "tpu"},
        {"seed": "many"},
        {"share": "/mnt/store"},
        {"steps": 5},
    ],
)
def test_what_does_not_fit_is_refused_before_it_runs(deployments, given):
    from prefect.exceptions import ParameterTypeError, SignatureMismatchError

    with pytest.raises((ParameterTypeError, SignatureMismatchError)):
        deployments.make_asset.validate_parameters(GOOD | given)


def test_server_refuses_what_does_not_fit_the_form(deployments):
    from prefect.client.orchestration import get_client
    from prefect.exceptions import PrefectHTTPStatusError

    deployment = deployments.make_asset.to_deployment("refuses").apply()
    with get_client(sync_client=True) as client:
        for given in ({"source": "shoe.png"}, {"preset": "best"}, {"skip": ["nerf"]}):
            with pytest.raises(PrefectHTTPStatusError, match="409"):
                client.create_flow_run_from_deployment(deployment, parameters=GOOD | given)
        assert client.create_flow_run_from_deployment(deployment, parameters=GOOD).id


def test_what_only_the_program_can_tell_fails_in_words(deployments, source, tmp_path):
    given = {"source": str(source), "output": str(tmp_path / "out"), "store": str(tmp_path / "s")}
    for settings, complaint in (
        (["nerf.stepps=5"], "did you mean nerf.steps"),
        ([], "wanted a photo, a mesh or a scene"),
    ):
        state = deployments.make_asset(**given, settings=settings, return_state=True)
        assert state.is_failed() and complaint in state.message


def test_deployed_run_is_a_run_like_any_other(make_tiny, source, tmp_path):
    store, out = tmp_path / "store", tmp_path / "out"
    given = {"source": str(source), "output": str(out), "store": str(store)}
    assert make_tiny(**given, return_state=True).is_completed()
    record = RunIndex(store).find("out")
    assert record.state == DONE and record.command[:2] == ("run", str(source))
    assert (out / "total.safetensors").is_file()
    assert make_tiny(**given, return_state=True).is_completed()
    states = {stage.state for stage in RunIndex(store).find("out").stages.values()}
    assert states == {"cached"}


def test_fault_of_a_stage_fails_the_run_and_names_the_stage(make_tiny, source, tmp_path):
    given = {"source": str(source), "output": str(tmp_path / "o"), "store": str(tmp_path / "s")}
    state = make_tiny(**given, settings=["walk.fault=input"], return_state=True)
    assert state.is_failed() and state.message == "walk: the walk cannot start here"


def test_run_whose_job_is_stopped_was_cancelled(engine, store, source, tmp_path):
    from prefect.exceptions import TerminationSignal

    plan = plan_tiny(store, source)
    recorder = RunRecorder(store, plan, tmp_path / "out", preset="", command=())
    with pytest.raises(TerminationSignal), recorder:
        raise TerminationSignal(signal=15)
    assert recorder.record.state == CANCELLED


def test_many_inputs_become_a_table(deployments, tmp_path, monkeypatch):
    from flows import batch, batch_inputs

    for module in (batch, batch_inputs):
        monkeypatch.setattr(module, "PipelineConfig", TinyConfig)
    monkeypatch.setattr(batch, "IMAGE_TO_ASSET", TINY_FILES)
    (tmp_path / "a.txt").write_text("1 2")
    given = {"store": str(tmp_path / "store"), "output": str(tmp_path / "out")}
    there, missing = str(tmp_path / "a.txt"), str(tmp_path / "b.txt")
    table = tmp_path / "out" / "results.csv"
    state = deployments.make_assets(inputs=[there, missing], **given, return_state=True)
    assert state.is_failed() and state.message == f"see {table}"
    assert (tmp_path / "out" / "a" / "total.safetensors").is_file()
    state = deployments.make_assets(inputs=[there], **given, return_state=True)
    assert state.is_completed() and state.message == str(table)


def test_prefect_yaml_deploys_what_there_is(deployments, automations):
    page = yaml.safe_load((PROJECT / "prefect.yaml").read_text())
    entrypoints = [entry["entrypoint"] for entry in page["deployments"]]
    assert entrypoints == [f"flows.deployments.{name}" for name in DEPLOYED]
    for entry in page["deployments"]:
        deployed = getattr(deployments, entry["entrypoint"].rpartition(".")[2])
        assert set(entry["parameters"]) <= set(form(deployed))
        for schedule in entry.get("schedules", []):
            given = entry["parameters"] | schedule.get("parameters", {})
            # What a template stands for is known when it is deployed.
            plain = yaml.safe_load(re.sub("{{.*?}}", "/x", yaml.safe_dump(given)))
            deployed.validate_parameters(plain)
            assert schedule["active"] == (deployed is deployments.resume_crashed)
        environment = entry["work_pool"]["job_variables"]["env"]
        assert environment["PREFECT_FLOWS_HEARTBEAT_FREQUENCY"] == str(automations.HEARTBEAT_S)
        assert entry["tags"] == [automations.TAG]
    assert environment.items() >= cli.THREADING.items()
    resume = page["deployments"][-1]
    assert resume["parameters"]["attempts"] == automations.DEFAULT_ATTEMPTS
    assert resume["schedules"][0]["cron"] == automations.RESUME_CRON


def crashed_run(crashes: int, **changes) -> tuple[SimpleNamespace, list]:
    from prefect.states import Crashed, Pending, Running, Scheduled

    states = [Scheduled(), *(s() for _ in range(crashes) for s in (Pending, Running, Crashed))]
    run = {"state": states[-1], "deployment_id": uuid4()}
    return SimpleNamespace(**(run | changes)), states


def test_crashed_run_gets_so_many_further_tries_and_no_more(automations):
    for crashes, pause_s in ((1, 10), (2, 20), (3, 40)):
        before = datetime.now(UTC)
        verdict = automations.judge(*crashed_run(crashes), attempts=3)
        assert verdict.state.is_scheduled()
        wait = verdict.state.state_details.scheduled_time - before
        assert timedelta(0) <= wait - timedelta(seconds=pause_s) < timedelta(seconds=5)
    verdict = automations.judge(*crashed_run(4), attempts=3)
    # Failed, not crashed: that would be looked at again, for ever.
    assert verdict.state.is_failed() and "crashed 4 times" in verdict.state.message


def test_crash_before_the_run_ran_counts_too(automations):
    from prefect.states import Crashed, Pending, Scheduled

    states = [Scheduled(), *(s() for _ in range(4) for s in (Pending, Crashed))]
    run = SimpleNamespace(state=states[-1], deployment_id=uuid4(), run_count=0)
    assert automations.judge(run, states, attempts=3).state.is_failed()


def test_run_that_is_not_crashed_or_not_deployed_is_left_alone(automations):
    from prefect.states import Cancelled, Completed, Running

    for state in (Running(), Completed(), Cancelled(), None):
        run, states = crashed_run(1, state=state)
        assert automations.judge(run, states, attempts=3).state is None
    run, states = crashed_run(1, deployment_id=None)
    assert automations.judge(run, states, attempts=3).state is None


def test_one_look_at_crashed_runs_comes_to_all_of_them(deployments, make_tiny, automations):
    """Also to those whose event was lost; what is not ours, or old, is left alone."""
    from prefect.client.orchestration import get_client
    from prefect.states import Completed, Crashed, Running, Scheduled

    ours = make_tiny.to_deployment("looked-at", tags=[automations.TAG]).apply()
    others = make_tiny.to_deployment("not-ours").apply()
    with get_client(sync_client=True) as client:

        def run(deployment, *states):
            made = client.create_flow_run_from_deployment(deployment, parameters=GOOD)
            for state in states:
                client.set_flow_run_state(made.id, state, force=True)
            return made.id

        old = Scheduled(scheduled_time=datetime.now(UTC) - timedelta(hours=30))
        runs = [
            run(ours, Running(), Crashed()),
            run(ours, Crashed()),
            run(ours, *(Crashed() for _ in range(3))),
            run(ours, Running(), Completed()),
            run(others, Running(), Crashed()),
            client.create_flow_run_from_deployment(ours, parameters=GOOD, state=old).id,
        ]
        client.set_flow_run_state(runs[-1], Crashed(), force=True)
        state = deployments.resume_crashed(attempts=2, return_state=True)
        assert state.message == "2 runs get another try, 1 were given up"
        names = [client.read_flow_run(id_).state.name for id_ in runs]
        waits = "AwaitingRetry"
        assert names == [waits, waits, "Failed", "Completed", "Crashed", "Crashed"]
        state = deployments.resume_crashed(attempts=2, return_state=True)
        assert state.message == "0 runs get another try, 0 were given up"


def test_rule_never_watches_the_flow_that_it_starts(automations):
    resume, watched = uuid4(), [uuid4(), uuid4()]
    rule = automations.resume_rule("pool", resume, watched)
    related = rule.trigger.match_related
    assert related["prefect.resource.id"] == sorted(f"prefect.deployment.{i}" for i in watched)
    assert rule.actions[0].deployment_id == resume


def test_zombie_rules_wait_longer_than_heartbeats_come_apart(automations):
    silent, pending = automations.zombie_rules()
    assert silent.trigger.within >= timedelta(seconds=3 * automations.HEARTBEAT_S)
    assert silent.trigger.after == {"prefect.flow-run.heartbeat"}
    assert pending.trigger.after == {"prefect.flow-run.Pending"}
    for rule in (silent, pending):
        assert rule.trigger.for_each == {"prefect.resource.id"}
        assert rule.actions[0].state == "CRASHED" and not rule.actions[0].force


def test_rules_are_registered_once_and_stay_switched_off(deployments, make_tiny, automations):
    from prefect.client.orchestration import get_client

    with get_client(sync_client=True) as client:
        assert set(automations.register(client).values()) == {"made"}
        assert len(client.read_automations()) == 2  # nothing is deployed that could resume
        for deployed in (make_tiny, deployments.resume_crashed):
            deployed.to_deployment("pool", tags=[automations.TAG]).apply()
        outcome = automations.register(client)
        assert sorted(outcome.values()) == ["made", "stays", "stays"]
        rules = {rule.name: rule for rule in client.read_automations()}
        silent = rules["svim3d: silent runs"]
        client.pause_automation(silent.id)
        assert set(automations.register(client).values()) == {"stays"}
        changed = automations.register(client, silent_s=300)
        assert changed[silent.name] == "changed"
        again = client.read_automation(silent.id)
        assert again.trigger.within == timedelta(seconds=300) and not again.enabled
        assert len(client.read_automations()) == 3


def test_without_a_server_the_command_says_how_to_start_one(engine, capsys):
    from prefect.settings import PREFECT_API_URL, temporary_settings

    for command in ("serve", "automations"):
        with temporary_settings(restore_defaults={PREFECT_API_URL}):
            assert cli.main([command]) == cli.BAD_INPUT
        assert "prefect server start" in capsys.readouterr().err
        with temporary_settings({PREFECT_API_URL: "http://127.0.0.1:9/api"}):
            assert cli.main([command]) == cli.BAD_INPUT
        assert "does not answer" in capsys.readouterr().err


def test_heartbeats_are_sent_for_deployments_alone(engine, monkeypatch):
    from prefect.settings import PREFECT_FLOWS_HEARTBEAT_FREQUENCY as FREQUENCY
    from prefect.settings import temporary_settings

    from flows.heartbeats import DEPLOYED_RUN, heartbeats_if_deployed

    with temporary_settings({FREQUENCY: 30}):
        with heartbeats_if_deployed():
            assert FREQUENCY.value() is None
        monkeypatch.setenv(DEPLOYED_RUN, str(uuid4()))
        with heartbeats_if_deployed():
            assert FREQUENCY.value() == 30
