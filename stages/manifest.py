"""The page that lies beside every artifact: what made it, what it holds, and a seal over both."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

from stages.keys import Recipe, digest_file, digest_json

MANIFEST_NAME = "manifest.json"


@dataclass(frozen=True)
class FileRecord:
    """One file of an artifact as it was published."""

    size: int
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """Everything known about a published artifact.

    Attributes:
        recipe: what it was made from; its digest is the key.
        files: by path relative to the artifact's folder, the manifest itself apart.
        record: how the making went: seconds, peak memory, device, host, events, ...
    """

    recipe: Recipe
    files: dict[str, FileRecord]
    record: dict[str, Any]

    @classmethod
    def of(cls, folder: Path, recipe: Recipe, record: Mapping[str, Any]) -> Self:
        """Describe the files that lie in `folder` now."""
        files = {
            file.relative_to(folder).as_posix(): FileRecord(file.stat().st_size, digest_file(file))
            for file in sorted(folder.rglob("*"))
            if file.is_file()
        }
        return cls(recipe, files, dict(record))

    @property
    def seal(self) -> str:
        """Digest of the manifest: tells an edited page, and names the content of the artifact."""
        return digest_json(asdict(self))

    @property
    def size(self) -> int:
        """Bytes of all files together."""
        return sum(file.size for file in self.files.values())

    def write(self, folder: Path) -> None:
        """Write the sealed page into the artifact's folder."""
        page = {"key": self.recipe.key, **asdict(self), "seal": self.seal}
        (folder / MANIFEST_NAME).write_text(json.dumps(page, indent=1))

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read the page back.

        Raises:
            ValueError: if it is missing, no JSON, incomplete, or does not match its seal.
        """
        try:
            page = json.loads((folder / MANIFEST_NAME).read_text())
            files = {name: FileRecord(**entry) for name, entry in page["files"].items()}
            manifest = cls(Recipe(**page["recipe"]), files, page["record"])
            is_genuine = page["seal"] == manifest.seal and page["key"] == manifest.recipe.key
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{MANIFEST_NAME} is unreadable: {error}") from error
        if not is_genuine:
            raise ValueError(f"{MANIFEST_NAME} was edited: it does not match its seal")
        return manifest

    def damage(self, folder: Path, *, hashes: bool) -> str | None:
        """What is wrong with the files in `folder`, or None; sizes always, content on request."""
        for name, expected in self.files.items():
            file = folder / name
            if not file.is_file():
                return f"{name} is gone"
            if (size := file.stat().st_size) != expected.size:
                return f"{name} has {size} bytes instead of {expected.size}"
            if hashes and digest_file(file) != expected.sha256:
                return f"{name} has changed its content"
        return None
