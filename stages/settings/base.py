"""What all stage settings share."""

import hashlib
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, model_validator


class StageConfig(BaseModel):
    """Frozen settings of one stage; an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class FileReadingConfig(StageConfig):
    """Settings that may name files, whose content is as much a part of them as their name."""

    digests: dict[str, str] = {}
    """Sha256 of each file named by another setting, filled in by itself."""

    @model_validator(mode="before")
    @classmethod
    def _digest_files(cls, given: Any) -> Any:
        """Read the digests whenever the settings are made."""
        if not isinstance(given, dict):
            return given
        named = {
            name: Path(given[name])
            for name, field in cls.model_fields.items()
            if field.annotation == Path | None and given.get(name) is not None
        }
        digests = {
            name: hashlib.sha256(file.read_bytes()).hexdigest()
            for name, file in named.items()
            if file.is_file()
        }
        return given | {"digests": digests} if digests else given
