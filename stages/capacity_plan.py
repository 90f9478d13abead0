"""What the views ask of the stages: for each setting its value, its evidence, and the sentence why.

Sizes in a stage's settings are upper bounds where there is a plan: it lowers them and says so in an
event.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self, TypeVar

from stages.base import Context
from stages.settings.base import StageConfig
from stages.settings.nerf import NerfConfig
from svim3d.fields.hash_grid import FEATURES, HashGridSpec

GRIDS, SHARES = "grid_nodes", "grid_shares"  # a schedule: the plan limits its last entry
ConfigT = TypeVar("ConfigT", bound=StageConfig)


@dataclass(frozen=True)
class Choice:
    """One setting's value as the views have it.

    Attributes:
        setting: its dotted name.
        value: what is enough.
        because: what that was read from.
    """

    setting: str
    value: float
    because: str


@dataclass(frozen=True)
class CapacityPlan:
    """What the views ask for.

    Attributes:
        choices: one for each setting that is not left as it is.
        evidence: the figures behind them, by name.
    """

    choices: tuple[Choice, ...]
    evidence: dict[str, float]

    def save(self, folder: Path) -> None:
        """Write one readable file."""
        (folder / "capacity.json").write_text(json.dumps(asdict(self), indent=1))

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read it."""
        page = json.loads((folder / "capacity.json").read_text())
        return cls(tuple(Choice(**choice) for choice in page["choices"]), page["evidence"])

    def value_of(self, setting: str) -> float | None:
        """What is enough of a setting; None where the plan says nothing of it."""
        return next((c.value for c in self.choices if c.setting == setting), None)

    def headline(self) -> str:
        """The sizes that matter most."""
        names = {
            "hash": "nerf.hash_finest",
            "grid": "nerf.grid_nodes",
            "light": "env_preopt.size",
            "images": "nerf.image_size",
            "texture": "uv_bake.texture_size",
        }
        said = {name: self.value_of(setting) for name, setting in names.items()}
        return ", ".join(f"{name} {value:g}" for name, value in said.items() if value is not None)


def bounded(config: ConfigT, plan: CapacityPlan | None, ctx: Context) -> ConfigT:
    """A stage's settings, no larger than the plan has them; every change is told as an event.

    Args:
        config: the stage's own: upper bounds.
        plan: None leaves everything as it is.
        ctx: of the stage.
    """
    if plan is None:
        return config
    changed: dict[str, Any] = {}
    for choice in plan.choices:
        stage, _, name = choice.setting.partition(".")
        if stage != ctx.stage:
            continue
        most = getattr(config, name)
        if name == GRIDS:
            limit = round(choice.value)
            grids, shares = limited_schedule(most, getattr(config, SHARES), limit)
            changed |= {GRIDS: grids, SHARES: shares}
            used, most = grids[-1], most[-1]
        else:
            used = changed[name] = min(choice.value, most)
        ctx.event("capacity", f"{name} {used:g} of {most:g}: {choice.because}", tell=False)
    found = type(config).model_validate(config.model_dump() | changed)
    if isinstance(config, NerfConfig) and isinstance(found, NerfConfig):
        used, most = parameter_count(found), parameter_count(config)
        ctx.event(
            "capacity", f"parameters {used:,} of {most:,}: hash grid and distances", tell=False
        )
    return found


def parameter_count(config: NerfConfig) -> int:
    """Numbers that phase 1 fits: features of the hash grid and distances at the finest nodes."""
    spec = HashGridSpec(
        config.hash_levels, config.hash_log2_entries, config.hash_coarsest, config.hash_finest
    )
    return FEATURES * sum(spec.sizes) + config.grid_nodes[-1] ** 3


def limited_schedule(
    nodes: tuple[int, ...], shares: tuple[float, ...], limit: int
) -> tuple[tuple[int, ...], tuple[float, ...]]:
    """A schedule of growing grids that ends at `limit`, or where it did if that is less."""
    kept = [grid for grid in nodes if grid < limit]
    if len(kept) == len(nodes):
        return nodes, shares
    return (*kept, limit), shares[: len(kept) + 1]
