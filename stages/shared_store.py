"""A store that several machines share: a local one that fetches from and publishes to a URL.

    <url>/data/<key>/<attempt>/...   files of an artifact, in a place of their own per upload
    <url>/obj/<key>.json             written last: its presence is what makes the artifact exist

Object stores know no rename, but write an object whole or not at all; what is fetched is checked
against its manifest's seal and hashes all the same, which also covers file systems that do not.
An upload that was cut leaves files that nobody refers to. The local store's locks keep the
processes of one machine from computing a key twice; two machines that do so at the same moment
publish equal recipes, the last pointer counts, and both uploads are whole.
"""

import json
import shutil
import uuid
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

from stages.errors import InputError
from stages.keys import Recipe
from stages.manifest import MANIFEST_NAME, Manifest
from stages.store import Compute, Store, Stored


def open_store(root: Path, share: str | None, *, say: Callable[[str], None]) -> Store:
    """The local store at `root`, backed by the one at the URL `share` where there is one."""
    return Store(root, say=say) if share is None else SharedStore(root, share, say=say)


class SharedStore(Store):
    """A local store in front of one that others use too.

    Args:
        root: folder of the local store, which caches what it fetches.
        url: of any file system that fsspec knows: s3://bucket/folder, file:///mnt/shared, ...
        say: told what an operator should know.

    Raises:
        InputError: the URL's kind is unknown, or its package is missing.
    """

    def __init__(self, root: Path, url: str, *, say: Callable[[str], None]) -> None:
        super().__init__(root, say=say)
        import fsspec  # not for those who have no such store

        self._url = url
        try:
            self._files, self._base = fsspec.core.url_to_fs(url)
        except (ImportError, ValueError) as error:
            raise InputError(f"the shared store {url} cannot be reached: {error}") from error

    def obtain(self, recipe: Recipe, compute: Compute, *, force: bool = False) -> Stored:
        """As `Store.obtain`; what is not here is looked for there, and what is new goes there.

        Raises:
            OSError: the shared store does not answer; what was computed is in the local one.
            TransientError: the disk is full, or another process holds the key for too long.
            InputError: the local store cannot be written.
        """
        if not force and self.check(recipe.key).stored is None:
            self._fetch(recipe.key)
        stored = super().obtain(recipe, compute, force=force)
        if not stored.is_cached or self._pointer(recipe.key) is None:
            self._upload(stored)
        return stored

    def _pointer_path(self, key: str) -> str:
        return f"{self._base}/obj/{key}.json"

    def _pointer(self, key: str) -> dict[str, Any] | None:
        """What tells where an artifact lies there, None where there is none or half of it."""
        try:
            pointer = json.loads(self._files.cat_file(self._pointer_path(key)))
            return {"folder": str(pointer["folder"]), "manifest": str(pointer["manifest"])}
        except (FileNotFoundError, ValueError, KeyError, TypeError):
            return None

    def _fetch(self, key: str) -> None:
        """Take an artifact over, if it is there and sound."""
        if (pointer := self._pointer(key)) is None:
            return
        with self._explained(), self._locked(key):
            if self.check(key).stored:  # another process was faster
                return
            self._require_space()
            fetched = self.work(key) / "fetched"
            shutil.rmtree(fetched, ignore_errors=True)
            fetched.mkdir(parents=True)
            if damage := self._download(key, pointer, fetched):
                self._say(f"artifact {key[:8]} in {self._url} is damaged ({damage}): not taken")
                shutil.rmtree(fetched)
                return
            self._quarantine_if_damaged(key)
            self._publish(key, fetched)

    def _download(self, key: str, pointer: dict[str, Any], folder: Path) -> str | None:
        """Copy an artifact into a folder; returns what is wrong with it."""
        (folder / MANIFEST_NAME).write_text(pointer["manifest"])
        try:
            manifest = Manifest.read(folder)
        except ValueError as error:
            return str(error)
        if manifest.recipe.key != key:
            return "the manifest belongs to another key"
        for name in manifest.files:
            path = PurePosixPath(name)
            if path.is_absolute() or ".." in path.parts:
                return f"{name} lies outside of it"
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            try:
                self._files.get_file(f"{self._base}/{pointer['folder']}/{name}", folder / name)
            except FileNotFoundError:
                return f"{name} is gone"
        return manifest.damage(folder, hashes=True)

    def _upload(self, stored: Stored) -> None:
        """Copy an artifact there, its files first, the pointer to them last."""
        artifact = self.artifact(stored.key)
        folder = f"data/{stored.key}/{uuid.uuid4().hex}"
        for name in stored.manifest.files:
            target = f"{self._base}/{folder}/{name}"
            self._files.makedirs(target.rpartition("/")[0], exist_ok=True)
            self._files.put_file(artifact / name, target)
        pointer = {"folder": folder, "manifest": (artifact / MANIFEST_NAME).read_text()}
        self._files.makedirs(f"{self._base}/obj", exist_ok=True)
        self._files.pipe_file(self._pointer_path(stored.key), json.dumps(pointer).encode())
