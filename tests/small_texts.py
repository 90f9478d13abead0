"""The smallest artifact, a text, and recipes for it."""

from dataclasses import dataclass
from pathlib import Path

from stages.keys import Recipe


@dataclass(frozen=True)
class Text:
    value: str

    def save(self, folder: Path) -> None:
        (folder / "text.txt").write_text(self.value)

    @classmethod
    def load(cls, folder: Path) -> "Text":
        return cls((folder / "text.txt").read_text())

    def headline(self) -> str:
        return f"{len(self.value)} letters"


def recipe(stage: str) -> Recipe:
    return Recipe(stage, {}, 3, {}, {}, {})
