"""What all stage settings share."""

import hashlib
from pathlib import Path
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, model_validator


class StageConfig(BaseModel):
    """Frozen settings of one stage; an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


# What counts of a folder that a setting names.
DIGESTED_SUFFIXES = (".json", ".safetensors")


class FileReadingConfig(StageConfig):
    """Settings that may name files or folders, whose content is as much a part as their name."""

    bundled: ClassVar[dict[str, Path]] = {}
    """What a setting stands for while it is None, where that has content of its own."""

    digests: dict[str, str] = {}
    """Sha256 of each file named by another setting, filled in by itself."""

    @model_validator(mode="before")
    @classmethod
    def _digest_files(cls, given: Any) -> Any:
        """Read the digests whenever the settings are made."""
        if not isinstance(given, dict):
            return given
        named = cls.bundled | {
            name: Path(given[name])
            for name, field in cls.model_fields.items()
            if field.annotation == Path | None and given.get(name) is not None
        }
        digests = {}
        for name, path in named.items():
            listed = sorted(path.iterdir()) if path.is_dir() else [path]
            files = [f for f in listed if f == path or f.suffix in DIGESTED_SUFFIXES]
            for file in (f for f in files if f.is_file()):
                with file.open("rb") as stream:
                    digest = hashlib.file_digest(stream, "sha256").hexdigest()
                digests[name if file == path else f"{name}/{file.name}"] = digest
        return given | {"digests": digests} if digests else given
