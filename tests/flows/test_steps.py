"""Steps without an engine: passing faults are tried again, lasting ones are not."""

import pytest
import torch
from tiny_runs import compute, plan_tiny

from flows.steps import Bench, obtain_step_patiently
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
