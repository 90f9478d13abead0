"""Adam over named parameters, whose whole state is a flat dictionary of tensors."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.optim.adam import adam

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
    """Adam with a rate per parameter, a common schedule, and parameters that may be replaced.

    It calls torch's fused step itself: the first `torch.optim.Optimizer` of a process imports
    torch's compiler, which takes longer than some stages.

    Args:
        parameters: what is optimised, by name.
        rates: of each.
        betas: decay of the first and of the second moment.
    """

    def __init__(
        self,
        parameters: Mapping[str, nn.Parameter],
        rates: Mapping[str, Rate],
        *,
        betas: tuple[float, float] = BETAS,
    ) -> None:
        self.parameters = dict(parameters)
        self._rates = dict(rates)
        self._betas = betas
        self._state: dict[str, dict[str, Tensor]] = {}

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for parameter in self.parameters.values():
            parameter.grad = None

    def gradients(self) -> dict[str, Tensor]:
        """Sum of each parameter's gradient: finite unless some entry is not."""
        named = self.parameters.items()
        return {f"gradient of {n}": p.grad.sum() for n, p in named if p.grad is not None}

    @torch.no_grad()
    def step(self, share: float) -> None:
        """One step at `share` of every rate, of all parameters that have a gradient."""
        for name, parameter in self.parameters.items():
            if parameter.grad is None:
                continue
            state = self._state.get(name) or self._begin(name)
            adam(
                [parameter],
                [parameter.grad],
                [state["exp_avg"]],
                [state["exp_avg_sq"]],
                [],
                [state["step"]],
                fused=True,
                amsgrad=False,
                beta1=self._betas[0],
                beta2=self._betas[1],
                lr=self._rates[name].step * share,
                weight_decay=0.0,
                eps=self._rates[name].eps,
                maximize=False,
            )

    def _begin(self, name: str) -> dict[str, Tensor]:
        """State of a parameter without a past; the fused step counts on the parameter's device."""
        value = self.parameters[name].detach()
        moments = {moment: torch.zeros_like(value) for moment in MOMENTS}
        self._state[name] = {"step": torch.zeros((), device=value.device), **moments}
        return self._state[name]

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
        state = self._state.pop(name, None)
        self.parameters[name], self._rates[name] = parameter, rate
        if state and carry is not None:
            carried = {moment: carry(moment, state[moment]) for moment in MOMENTS}
            self._state[name] = {"step": state["step"], **carried}

    def remove(self, name: str) -> None:
        """Forget a parameter."""
        del self.parameters[name]
        self._state.pop(name, None)

    def state(self) -> dict[str, Tensor]:
        """Parameters, moments and step counts, detached."""
        tensors = {f"value.{name}": p.detach() for name, p in self.parameters.items()}
        for name, state in self._state.items():
            tensors |= {f"{key}.{name}": value for key, value in state.items()}
        return tensors

    def load_state(self, tensors: Mapping[str, Tensor]) -> None:
        """Take over what `state` gave; parameters must already have their shapes."""
        self._state.clear()
        with torch.no_grad():
            for name, parameter in self.parameters.items():
                parameter.copy_(tensors[f"value.{name}"])
                keys = [key for key in ("step", *MOMENTS) if f"{key}.{name}" in tensors]
                if keys:
                    self._state[name] = {
                        key: tensors[f"{key}.{name}"].clone().to(parameter.device) for key in keys
                    }


def cosine(step: int, steps: int, warm_up: int, final: float) -> float:
    """Share of the full rate at a step: a linear rise, then half a cosine down to `final`."""
    rise = min(1.0, (step + 1) / max(warm_up, 1))
    done = min(step / max(steps, 1), 1.0)
    return rise * (final + (1.0 - final) * 0.5 * (1.0 + math.cos(math.pi * done)))
