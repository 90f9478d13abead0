"""Adam over named parameters, whose whole state is a flat dictionary of tensors."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

BETAS = (0.9, 0.99)  # Source: Mueller et al. 2022, sec. 4: short memory for sparse gradients
MOMENTS = ("exp_avg", "exp_avg_sq")


@dataclass(frozen=True)
class Rate:
    """How one parameter is stepped.

    Attributes:
        step: Adam's step at full rate, in units of the parameter.
        eps: what is added to the root of the second moment; far below typical gradients lets rarely
            seen entries move at full rate, far above them leaves such entries alone.
    """

    step: float
    eps: float = 1e-15


class NamedAdam:
    """Adam with a rate per parameter, a common schedule, and parameters that may be replaced."""

    def __init__(self, parameters: Mapping[str, nn.Parameter], rates: Mapping[str, Rate]) -> None:
        self.parameters = dict(parameters)
        self._rates = dict(rates)
        groups = [
            {"params": [p], "name": n, "eps": rates[n].eps} for n, p in self.parameters.items()
        ]
        self._adam = torch.optim.Adam(groups, lr=0.0, betas=BETAS, fused=True)

    def zero_grad(self) -> None:
        """Forget the gradients."""
        self._adam.zero_grad(set_to_none=True)

    def gradients(self) -> dict[str, Tensor]:
        """Sum of each parameter's gradient: finite unless some entry is not."""
        named = self.parameters.items()
        return {f"gradient of {n}": p.grad.sum() for n, p in named if p.grad is not None}

    def step(self, share: float) -> None:
        """One step at `share` of every rate."""
        for group in self._adam.param_groups:
            group["lr"] = self._rates[group["name"]].step * share
        self._adam.step()

    def replace(
        self,
        name: str,
        parameter: nn.Parameter,
        rate: Rate,
        carry: Callable[[str, Tensor], Tensor] | None = None,
    ) -> None:
        """Put another parameter in a name's place.

        Args:
            name: whose.
            parameter: the new one.
            rate: its rate.
            carry: (`exp_avg` or `exp_avg_sq`, old moment) -> moment of the new parameter; without
                it the new parameter starts without a past.
        """
        state = self._adam.state.pop(self.parameters[name], None)
        (group,) = [g for g in self._adam.param_groups if g["name"] == name]
        group["params"] = [parameter]
        self.parameters[name], self._rates[name] = parameter, rate
        if state and carry is not None:
            carried = {moment: carry(moment, state[moment]) for moment in MOMENTS}
            self._adam.state[parameter] = {"step": state["step"], **carried}

    def remove(self, name: str) -> None:
        """Forget a parameter."""
        self._adam.state.pop(self.parameters.pop(name), None)
        groups = self._adam.param_groups
        groups[:] = [group for group in groups if group["name"] != name]

    def state(self) -> dict[str, Tensor]:
        """Parameters, moments and step counts, detached."""
        tensors = {f"value.{name}": p.detach() for name, p in self.parameters.items()}
        for name, parameter in self.parameters.items():
            for key, value in self._adam.state[parameter].items():
                tensors[f"{key}.{name}"] = value
        return tensors

    def load_state(self, tensors: Mapping[str, Tensor]) -> None:
        """Take over what `state` gave; parameters must already have their shapes."""
        with torch.no_grad():
            for name, parameter in self.parameters.items():
                parameter.copy_(tensors[f"value.{name}"])
                keys = [key for key in ("step", *MOMENTS) if f"{key}.{name}" in tensors]
                if keys:
                    # Fused Adam counts its steps on the parameter's device.
                    self._adam.state[parameter] = {
                        key: tensors[f"{key}.{name}"].clone().to(parameter.device) for key in keys
                    }


def cosine(step: int, steps: int, warm_up: int, final: float) -> float:
    """Share of the full rate at a step: a linear rise, then half a cosine down to `final`."""
    rise = min(1.0, (step + 1) / max(warm_up, 1))
    done = min(step / max(steps, 1), 1.0)
    return rise * (final + (1.0 - final) * 0.5 * (1.0 + math.cos(math.pi * done)))
