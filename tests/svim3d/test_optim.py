"""Named Adam: equal to torch's, replaceable parameters, complete state."""

import subprocess
import sys

import pytest
import torch
from torch import nn

from svim3d.optim import NamedAdam, Rate


def quadratic_step(adam, share=1.0):
    adam.zero_grad()
    sum((p - 1.0).square().sum() for p in adam.parameters.values()).backward()
    adam.step(share)


def test_steps_equal_torch_adam():
    ours, theirs = nn.Parameter(torch.zeros(3)), nn.Parameter(torch.zeros(3))
    adam = NamedAdam({"a": ours}, {"a": Rate(0.1)})
    reference = torch.optim.Adam([theirs], lr=0.05, betas=(0.9, 0.99), eps=1e-15)
    for _ in range(5):
        quadratic_step(adam, share=0.5)
        reference.zero_grad()
        (theirs - 1.0).square().sum().backward()
        reference.step()
    torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_state_restores_bit_for_bit(device):
    def make():
        return NamedAdam({"a": nn.Parameter(torch.zeros(4, device=device))}, {"a": Rate(0.1)})

    first, second = make(), make()
    for _ in range(3):
        quadratic_step(first)
    # As a checkpoint gives it back: on the CPU.
    second.load_state({name: t.cpu().clone() for name, t in first.state().items()})
    for adam in (first, second):
        quadratic_step(adam)
    assert torch.equal(first.parameters["a"], second.parameters["a"])


def test_replaced_parameter_carries_its_moments_and_removed_one_is_gone():
    a, b = nn.Parameter(torch.zeros(2)), nn.Parameter(torch.zeros(1))
    adam = NamedAdam({"a": a, "b": b}, {"a": Rate(0.1), "b": Rate(0.1)})
    quadratic_step(adam)
    before = adam.state()["exp_avg.a"]
    longer = nn.Parameter(torch.zeros(4))
    adam.replace("a", longer, Rate(0.2), lambda _, old: old.repeat(2))
    assert torch.equal(adam.state()["exp_avg.a"], before.repeat(2))
    adam.remove("b")
    kept = float(b.detach())
    quadratic_step(adam)
    assert set(adam.parameters) == {"a"}
    assert float(b.detach()) == kept


def test_a_parameter_that_never_had_a_gradient_stays_and_begins_late():
    def make():
        idle, used = nn.Parameter(torch.ones(2)), nn.Parameter(torch.zeros(2))
        return NamedAdam({"idle": idle, "used": used}, {"idle": Rate(0.1), "used": Rate(0.1)})

    def step_used(adam):
        adam.zero_grad()
        (adam.parameters["used"] - 1.0).square().sum().backward()
        adam.step(1.0)

    first, second = make(), make()
    step_used(first)
    assert torch.equal(first.parameters["idle"], torch.ones(2))
    quadratic_step(second)  # a past that the loaded state has to wipe out
    second.load_state({name: t.clone() for name, t in first.state().items()})
    for adam in (first, second):
        (3.0 * adam.parameters["idle"]).sum().backward()
        adam.step(1.0)
    for name in ("idle", "used"):
        assert torch.equal(first.parameters[name], second.parameters[name])


def test_a_step_imports_no_compiler():
    code = (
        "import sys, torch; from svim3d.optim import NamedAdam, Rate\n"
        "p = torch.nn.Parameter(torch.zeros(1)); p.grad = torch.ones(1)\n"
        "NamedAdam({'p': p}, {'p': Rate(0.1)}).step(1.0)\n"
        "assert abs(float(p.detach()) + 0.1) < 1e-6 and 'torch._dynamo' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_one_bad_entry_shows_in_its_parameters_gradient():
    good, bad = nn.Parameter(torch.ones(3)), nn.Parameter(torch.zeros(3))
    adam = NamedAdam({"good": good, "bad": bad}, {"good": Rate(0.1), "bad": Rate(0.1)})
    # The root is finite at zero, its slope is not.
    (good.sum() + bad.sqrt()[0]).backward()
    finite = {name: bool(torch.isfinite(sum_)) for name, sum_ in adam.gradients().items()}
    assert finite == {"gradient of good": True, "gradient of bad": False}
