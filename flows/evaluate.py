"""`svim3d evaluate`: assets of a benchmark's objects against the truth, as the paper's tables.

Scores are artifacts: what the store has is not computed again, a killed evaluation goes on where
it was, and a case that fails is told and left out.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from flows.cases import Outcome
from flows.evaluate_cases import (
    Row,
    Subject,
    known_scores,
    plan_case,
    rows_of,
    run_case,
)
from flows.evaluate_files import MARKDOWN, write_tables
from flows.evaluate_options import PHOTO, VIEWS
from flows.evaluate_paper import notes_for
from flows.evaluate_tables import tables_of
from flows.stopping import interrupt_on_stop
from stages.errors import InputError
from stages.settings.table_scores import TableScoresConfig
from stages.store import Store

ALL_SCORED, SOME_FAILED = 0, 1
TRUTHS = "truth"  # folder of converted objects in the output folder
LEAST_SIZE = 16
WITHOUT_MATERIALS = ("stanford-orb", "gso")  # whose views no asset can be made of
Results = dict[str, dict[str, Mapping[str, Any]]]
Failures = list[tuple[str, str, str]]  # row, object, reason


def evaluate(options: argparse.Namespace) -> int:
    """Score what the command line names; the exit code is 1 where a case has no scores."""
    console = Console()
    if options.size < LEAST_SIZE:
        raise InputError(f"--size {options.size}: wanted {LEAST_SIZE} or more pixels")
    if options.made_from == VIEWS and options.suite in WITHOUT_MATERIALS:
        raise InputError(
            f"--from views needs views with materials, which {options.suite} has none of; say "
            "--from photo"
        )
    rows = rows_of(options.preset, options.set, options.row)
    suite = _Suite(options, console)
    if options.list:
        for name in suite.names:
            console.print(name, highlight=False, markup=False)
        return ALL_SCORED
    interrupt_on_stop()
    results: Results = {row.name: {} for row in rows}
    failures: Failures = []
    # Object by object: the first ones already fill all tables.
    for number, name in enumerate(suite.names):
        subject = suite.subject(name, failures, rows)
        if subject is None:
            continue
        for at, row in enumerate(rows):
            told = f"{number * len(rows) + at + 1}/{len(suite.names) * len(rows)}"
            suite.score(subject, row, results, failures, told)
            suite.write(results, failures)
    suite.write(results, failures)
    scored = sum(len(pages) for pages in results.values())
    console.print(
        f"{suite.out / MARKDOWN}: {scored} scored, {len(failures)} failed",
        highlight=False,
        soft_wrap=True,
    )
    return SOME_FAILED if failures else ALL_SCORED


class _Suite:
    """The objects of a suite, and where their scores go."""

    def __init__(self, options: argparse.Namespace, console: Console) -> None:
        from stages.suites import list_objects

        self._options, self._console = options, console
        made_from = options.made_from
        self.out: Path = options.output or Path("out") / f"evaluate-{options.suite}-{made_from}"
        self._store = Store(options.store)
        found = list_objects(options.suite, options.folder)
        unknown = [name for name in options.objects if name not in found]
        if unknown:
            raise InputError(f"--objects {unknown[0]}: wanted some of {', '.join(found)}")
        self.names = options.objects or found
        if options.lpips is not None and not options.lpips.is_file():
            raise InputError(f"--lpips: there is no file {options.lpips}; check the path")
        self._config = TableScoresConfig(
            from_photo=made_from == PHOTO,
            stanford_orb=options.suite == "stanford-orb",
            lpips_weights=options.lpips and options.lpips.resolve(),
        )

    def subject(self, name: str, failures: Failures, rows: Sequence[Row]) -> Subject | None:
        """An object in the layout of benchmark orbits; None, and a failure, if it is damaged."""
        from stages.suites import truth_folder

        options = self._options
        try:
            folder = truth_folder(
                options.suite, options.folder, name, self.out / TRUTHS, options.size
            )
        except InputError as error:
            for row in rows:
                self._fail(row.name, name, str(error), failures, "")
            return None
        return Subject(name, folder)

    def score(
        self, subject: Subject, row: Row, results: Results, failures: Failures, told: str
    ) -> None:
        """Scores of a case, from the store or computed."""
        options, from_photo = self._options, self._options.made_from == PHOTO
        try:
            case = plan_case(
                subject,
                row,
                self._store,
                from_photo=from_photo,
                config=self._config,
                seed=options.seed,
            )
        except InputError as error:
            self._fail(row.name, subject.name, str(error), failures, told)
            return
        page, state = known_scores(case, self._store), "known"
        if page is None:
            reason = run_case(
                case,
                from_photo=from_photo,
                seed=options.seed,
                device=options.device,
                store=self._store,
                limit_s=options.limit,
            )
            page, state = known_scores(case, self._store), "computed"
            if page is None:
                reason = reason or f"{Outcome.CRASHED}: no scores in the store"
                self._fail(row.name, subject.name, reason, failures, told)
                return
        results[row.name][subject.name] = page
        self._say(f"[{told}] {subject.name}, {row.name}: {state}")

    def write(self, results: Results, failures: Failures) -> None:
        """All tables of what is known by now."""
        suite = self._options.suite
        notes = {name: notes_for(suite, name) for name in _TABLES}
        tables = tables_of(results, notes)
        write_tables(tables, results, failures, self._told(results), self.out)

    def _told(self, results: Results) -> list[str]:
        """How it was measured."""
        options = self._options
        objects = dict.fromkeys(name for pages in results.values() for name in pages)
        changed = "".join(f" --set {setting}" for setting in options.set)
        source = "true views" if options.made_from == VIEWS else "one photo each"
        return [
            f"`svim3d evaluate {options.suite} --from {options.made_from} --preset "
            f"{options.preset}{changed} --seed {options.seed}`: {len(objects)} objects "
            f"({', '.join(objects) or 'none yet'}), made of {source}.",
            "Means over objects of means over views inside the true mask; pictures clipped to "
            "[0, 1] and sRGB-encoded; in brackets bootstrap intervals of 95 % over objects, in "
            "parentheses differences to the first row, paired by object. Lengths are shares of the "
            "longest side. Assets of photos are laid over the truth by the photo's view alone.",
        ]

    def _fail(self, row: str, name: str, reason: str, failures: Failures, told: str) -> None:
        failures.append((row, name, reason))
        last = reason.strip().splitlines()[-1]
        self._say(f"[{told}] {name}, {row}: failed: {last}", style="red")

    def _say(self, text: str, style: str | None = None) -> None:
        self._console.print(text, style=style, highlight=False, markup=False, soft_wrap=True)


_TABLES = (
    *("materials", "views", "relighting", "geometry", "ablation", "azimuth"),
    "stanford-orb",
)
