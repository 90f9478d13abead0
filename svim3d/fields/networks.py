"""Small multilayer perceptrons."""

import torch
from jaxtyping import Float
from torch import Tensor, nn


class Perceptron(nn.Module):
    """One hidden layer with ReLU, linear output.

    Positions come encoded, so one layer is enough to mix the levels; a second one gained nothing
    measurable on surface materials.
    """

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.first = nn.Linear(inputs, hidden)
        self.second = nn.Linear(hidden, outputs)

    def reset(self, generator: torch.Generator) -> None:
        """He's start for the hidden layer, zero biases, a small start for the output."""
        nn.init.kaiming_uniform_(self.first.weight, nonlinearity="relu", generator=generator)
        nn.init.kaiming_uniform_(self.second.weight, nonlinearity="linear", generator=generator)
        nn.init.zeros_(self.first.bias)
        nn.init.zeros_(self.second.bias)

    def forward(self, x: Float[Tensor, "N inputs"]) -> Float[Tensor, "N outputs"]:
        """Outputs before any range is imposed."""
        outputs: Tensor = self.second(torch.relu(self.first(x)))
        return outputs
