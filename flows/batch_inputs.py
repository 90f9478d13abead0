"""What a batch is made of: a manifest, a folder, a pattern or files become named entries."""

import csv
import glob
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flows.batch_results import RESULTS
from flows.commands import SHIPPED, input_path
from flows.config import PipelineConfig, setting_names
from stages.errors import InputError
from stages.keys import digest_json

MANIFESTS = (".csv", ".jsonl")
ORBIT_INDEX = "orbit.json"
# Columns of a manifest that are no settings.
COLUMNS = ("input", "name", "preset", "seed", "skip")
SUFFIX_DIGITS = 8  # of a digest, to tell entries of one name apart


@dataclass(frozen=True)
class Entry:
    """One input of a batch; what a manifest leaves open is taken from the command line.

    Attributes:
        source: as given, for people.
        path: where it lies.
        name: of its run folder.
        preset: of its own, if any.
        seed: of its own, if any.
        skip: stages left out beside those of the command line.
        overrides: settings, which come after those of the command line.
    """

    source: str
    path: Path
    name: str
    preset: str | None = None
    seed: int | None = None
    skip: frozenset[str] = frozenset()
    overrides: tuple[str, ...] = ()

    @property
    def digits(self) -> str:
        """What tells it from another entry of the same name, wherever it stands in the list."""
        own = (self.preset, self.seed, sorted(self.skip), self.overrides)
        return digest_json([str(self.path.resolve()), *own])[:SUFFIX_DIGITS]


def read_entries(given: Sequence[str], takes: Sequence[str]) -> list[Entry]:
    """All inputs, each once, with a name of its own.

    Args:
        given: paths of manifests (.csv, .jsonl), folders and inputs; patterns like `in/**/*.png`.
        takes: suffixes of the files in a folder that are inputs.

    Raises:
        InputError: there is nothing, or a manifest cannot be read.
    """
    entries = [entry for text in given for entry in _expanded(text, tuple(takes))]
    if not entries:
        raise InputError(
            f"{', '.join(given)}: no inputs there; give a manifest (.csv, .jsonl), a folder with "
            f"inputs ({', '.join(takes)}, orbit folders), or a quoted pattern like 'in/*.png'"
        )
    return _with_own_names(list(dict.fromkeys(entries)))


def _expanded(text: str, takes: tuple[str, ...]) -> Iterator[Entry]:
    path = input_path(text)
    if path.is_file() and path.suffix.lower() in MANIFESTS:
        yield from _read_manifest(path)
    elif path.is_dir() and not (path / ORBIT_INDEX).exists():
        yield from (_entry(str(p)) for p in sorted(path.iterdir()) if _is_input(p, takes))
    elif not path.exists() and glob.has_magic(text):
        # A pattern may be absolute or relative, which Path.glob does not take as they come.
        names = sorted(glob.glob(text, recursive=True))  # noqa: PTH207
        found = map(Path, names)
        yield from (_entry(str(p)) for p in found if p.is_file() or (p / ORBIT_INDEX).exists())
    else:
        yield _entry(text)  # one that is missing shows among the results, and stops no other


def _is_input(path: Path, takes: tuple[str, ...]) -> bool:
    if path.name.startswith("."):
        return False
    return (path / ORBIT_INDEX).is_file() if path.is_dir() else path.suffix.lower() in takes


def _entry(source: str, base: Path | None = None, **rest: Any) -> Entry:
    path = input_path(source) if source in SHIPPED or base is None else base / source
    # The last dot of a folder's name starts no ending.
    default = source if source in SHIPPED else (path.name if path.is_dir() else path.stem)
    return Entry(source, path, rest.pop("name", None) or default, **rest)


def _read_manifest(file: Path) -> Iterator[Entry]:
    try:
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"the manifest {file} cannot be read: {error}") from error
    rows = _csv_rows(file, text) if file.suffix.lower() == ".csv" else _json_rows(file, text)
    known = frozenset(setting_names(PipelineConfig))
    for place, row in rows:
        values = {name: value for name, value in row.items() if value not in (None, "")}
        if values:
            yield _row_entry(file, place, values, known)


def _csv_rows(file: Path, text: str) -> Iterator[tuple[str, dict[str, Any]]]:
    reader = csv.DictReader(text.splitlines(keepends=True))
    for row in reader:
        if None in row:
            raise InputError(f"{file}, line {reader.line_num}: more values than columns; quote it")
        yield f"line {reader.line_num}", {str(name).strip(): row[name] for name in row}


def _json_rows(file: Path, text: str) -> Iterator[tuple[str, dict[str, Any]]]:
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
        except ValueError as error:
            raise InputError(f"{file}, line {number}: no JSON ({error})") from error
        if not isinstance(row, dict):
            raise InputError(f'{file}, line {number}: wanted an object like {{"input": "a.png"}}')
        yield f"line {number}", row


def _row_entry(file: Path, place: str, row: Mapping[str, Any], known: frozenset[str]) -> Entry:
    if "input" not in row:
        raise InputError(f"{file}, {place}: no input; a manifest has a column of that name")
    if strange := [name for name in row if name not in COLUMNS and name not in known]:
        raise InputError(
            f"{file}, {place}: {', '.join(strange)} is neither a setting like nerf.steps nor one "
            f"of {', '.join(COLUMNS)}"
        )
    name = str(row["name"]).strip() if "name" in row else None
    if name is not None and (Path(name).name != name or name.startswith(".")):
        raise InputError(f"{file}, {place}: the name {name!r} is no name for a folder")
    try:
        seed = int(row["seed"]) if "seed" in row else None
    except (TypeError, ValueError):
        raise InputError(f"{file}, {place}: the seed {row['seed']!r} is no number") from None
    skip = row.get("skip", ())
    return _entry(
        str(row["input"]).strip(),
        file.parent,
        name=name,
        preset=str(row["preset"]).strip() if "preset" in row else None,
        seed=seed,
        skip=frozenset(skip.replace(",", " ").split() if isinstance(skip, str) else skip),
        overrides=tuple(
            f"{key}={value if isinstance(value, str) else json.dumps(value)}"
            for key, value in row.items()
            if key not in COLUMNS
        ),
    )


def _with_own_names(entries: Iterable[Entry]) -> list[Entry]:
    """Add digits to names that several entries, or we, would use on any file system."""
    listed = list(entries)
    uses = Counter(entry.name.casefold() for entry in listed)
    named = [
        replace(entry, name=f"{entry.name}-{entry.digits}")
        if uses[entry.name.casefold()] > 1 or entry.name.casefold() == RESULTS
        else entry
        for entry in listed
    ]
    again = [n for n, times in Counter(e.name.casefold() for e in named).items() if times > 1]
    if again:
        raise InputError(f"several inputs would be called {', '.join(again)}; name them otherwise")
    return named
