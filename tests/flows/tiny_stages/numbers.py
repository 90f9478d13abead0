"""What passes between the tiny stages."""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

from torch import Tensor

from svim3d.io.weights import load_tensors, save_tensors


@dataclass(frozen=True)
class Numbers:
    """A row of numbers."""

    values: Tensor

    def save(self, folder: Path) -> None:
        """Write one file."""
        save_tensors(folder / "numbers.safetensors", {"values": self.values})

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read it back."""
        return cls(load_tensors(folder / "numbers.safetensors")["values"])

    def headline(self) -> str:
        """Their sum."""
        return f"sum {self.values.sum():.6f}"
