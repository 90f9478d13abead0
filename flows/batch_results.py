"""The table of a batch, `results.csv`: a row for each input, whole at any moment."""

import csv
import io
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import astuple, dataclass, fields, replace
from enum import StrEnum
from pathlib import Path

from flows.run_folder import replace_file
from stages.errors import InputError

RESULTS = "results.csv"
# Rewriting a table of thousands of rows for each of them would be most of the work.
WRITE_EVERY_S = 1.0


class State(StrEnum):
    """What became of an input."""

    WAITING = "waiting"
    COMPUTED = "computed"
    CACHED = "cached"
    FAILED = "failed"
    CANCELLED = "cancelled"


DONE = (State.COMPUTED, State.CACHED)


@dataclass(frozen=True)
class Row:
    """One input.

    Attributes:
        name: of its run folder.
        input: as given.
        state: what became of it.
        seconds: from its start to its end.
        stage: that failed, empty where the fault lay elsewhere.
        error: the fault in a line.
        asset: the first product.
    """

    name: str
    input: str
    state: State = State.WAITING
    seconds: float = 0.0
    stage: str = ""
    error: str = ""
    asset: str = ""


class Results:
    """All rows, in the order of the inputs, and their file.

    Args:
        folder: of the batch, made if it is not there.
        rows: one for each input.

    Raises:
        InputError: the folder cannot be made or written.
    """

    def __init__(self, folder: Path, rows: Iterable[Row]) -> None:
        self.file = folder / RESULTS
        self._rows = {row.name: row for row in rows}
        self._written_s = 0.0
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self.write()
        except OSError as error:
            raise InputError(f"{self.file} cannot be written: {error}") from error

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def rows(self) -> list[Row]:
        """As they are now."""
        return list(self._rows.values())

    def count(self, *states: State) -> int:
        """How many inputs are in one of these states."""
        tally = Counter(row.state for row in self._rows.values())
        return sum(tally[state] for state in states)

    def put(self, row: Row) -> None:
        """Replace the row of that name; it reaches the file within a second, or at the end."""
        self._rows[row.name] = row
        if time.monotonic() - self._written_s > WRITE_EVERY_S:
            self.write()

    def cancel(self) -> None:
        """Say of what has not come to an end that it was cancelled."""
        for name, row in self._rows.items():
            if row.state is State.WAITING:
                self._rows[name] = replace(row, state=State.CANCELLED)

    def write(self) -> None:
        """Replace the file by the present state."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(field.name for field in fields(Row))
        writer.writerows(astuple(row) for row in self._rows.values())
        replace_file(self.file, text.getvalue().encode())
        self._written_s = time.monotonic()
