"""Steps without an engine: passing faults are tried again, lasting ones are not."""

import signal

import pytest
import torch
from tiny_runs import compute, plan_tiny

from flows.steps import Bench, obtain_step_patiently
from flows.stopping import interrupt_on_stop
from stages.errors import InputError


class Silent:
    def __init__(self) -> None:
        self.starts = 0

    def started(self, step):
        self.starts += 1

    def progressed(self, progress):
        pass

    def failed(self, step, error):
        pass

    def finished(self, step, stored):
        pass


@pytest.mark.parametrize(
    ("fault", "faults", "starts", "error"),
    [
        ("io", 2, 3, None),
        ("memory", 9, 3, MemoryError),
        ("input", 1, 1, InputError),
        ("defect", 1, 1, RuntimeError),
    ],
)
def test_kind_decides_how_often(store, source, fault, faults, starts, error):
    upstream = compute(plan_tiny(store, source, until="digits"), store)
    plan = plan_tiny(store, source, f"walk.fault={fault}", f"walk.faults={faults}")
    watcher = Silent()
    bench = Bench(plan, store, torch.device("cpu"), watcher)
    if error is None:
        stored = obtain_step_patiently(plan.steps[1], upstream, bench, (0.0, 0.0))
        assert [e["kind"] for e in stored.manifest.record["events"]] == 2 * ["io_fault"]
    else:
        with pytest.raises(error):
            obtain_step_patiently(plan.steps[1], upstream, bench, (0.0, 0.0))
    assert watcher.starts == starts


@pytest.fixture
def own_signals():
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_a_stop_that_compiled_code_swallowed_is_a_cancellation(store, source, own_signals):
    upstream = compute(plan_tiny(store, source, until="digits"), store)
    plan = plan_tiny(store, source, "walk.fault=lost interrupt", "walk.faults=1")
    bench = Bench(plan, store, torch.device("cpu"), Silent())
    interrupt_on_stop()
    with pytest.raises(KeyboardInterrupt):
        obtain_step_patiently(plan.steps[1], upstream, bench)
    interrupt_on_stop()  # what was wanted of a run is over with it
    assert obtain_step_patiently(plan.steps[1], upstream, bench).manifest.recipe.stage == "walk"
