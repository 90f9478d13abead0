"""What all stage settings share."""

from pydantic import BaseModel, ConfigDict


class StageConfig(BaseModel):
    """Frozen settings of one stage; an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)
