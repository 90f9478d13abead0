"""Three tiny stages wired like the real ones: an input, a long skippable stage, a final one."""

from tiny_settings import WalkConfig

from flows.config import RunConfig
from flows.pipeline import SOURCE, Node, Pipeline, Product
from stages.settings.base import StageConfig


class TinyConfig(RunConfig):
    """Settings of the tiny stages."""

    digits: StageConfig = StageConfig()
    walk: WalkConfig = WalkConfig()
    total: StageConfig = StageConfig()


TINY = Pipeline(
    name="tiny",
    nodes=(
        Node("digits", (SOURCE,), package="tiny_stages"),
        Node("walk", ("digits",), is_skippable=True, package="tiny_stages"),
        Node("total", ("digits", "walk"), package="tiny_stages"),
    ),
    products=(Product("total.safetensors", (("total", "numbers.safetensors"),)),),
)
