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
    missing_scores,
    plan_case,
    rows_of,
    run_case,
)
from flows.evaluate_files import MARKDOWN, Failure, write_tables
from flows.evaluate_options import PHOTO, VIEWS
from flows.evaluate_orb import NAME as ORB
from flows.evaluate_orb import orb_table
from flows.evaluate_paper import notes_for
from flows.evaluate_sets import samples_table, sets_table
from flows.evaluate_tables import Sample, tables_of
from flows.stopping import interrupt_on_stop
from stages.errors import InputError
from stages.installed import EFFICIENTNET_LITE0, installed_weights
from stages.settings.table_scores import TableScoresConfig
from stages.store import Store

ALL_SCORED, SOME_FAILED = 0, 1
TRUTHS = "truth"  # folder of converted objects in the output folder
LEAST_SIZE = 16
WITHOUT_MATERIALS = (ORB, "gso")  # whose views no asset can be made of
Page = Mapping[str, Any]


class _Scored:
    """What is known by now, by row, then by object and seed.

    Attributes:
        results: scores.
        missing: what Stanford-ORB's script tells where there is no asset, None where even the
            truth is damaged; of other suites nothing.
        failures: cases without scores.
    """

    def __init__(self, rows: Sequence[Row]) -> None:
        self.results: dict[str, dict[Sample, Page]] = {row.name: {} for row in rows}
        self.missing: dict[str, dict[Sample, Page | None]] = {row.name: {} for row in rows}
        self.failures: list[Failure] = []


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
    cases = [(row, seed) for seed in suite.seeds for row in rows]
    known = _Scored(rows)
    # Object by object: the first ones already fill all tables.
    for number, name in enumerate(suite.names):
        subject = suite.subject(name, known, cases)
        if subject is None:
            continue
        for at, (row, seed) in enumerate(cases):
            told = f"{number * len(cases) + at + 1}/{len(suite.names) * len(cases)}"
            suite.score(subject, row, seed, known, told)
            suite.write(known)
    suite.write(known, is_last=True)
    scored = sum(len(pages) for pages in known.results.values())
    console.print(
        f"{suite.out / MARKDOWN}: {scored} scored, {len(known.failures)} failed",
        highlight=False,
        soft_wrap=True,
    )
    return SOME_FAILED if known.failures else ALL_SCORED


def scores_config(options: argparse.Namespace) -> TableScoresConfig:
    """What is scored, and with which networks.

    Raises:
        InputError: a file of weights is not there.
    """
    for option, path in (("lpips", options.lpips), ("fid", options.fid)):
        if path is not None and not path.is_file():
            raise InputError(f"--{option}: there is no file {path}; check the path")
    if options.clip is not None and not options.clip.is_dir():
        raise InputError(
            f"--clip: wanted a folder with a CLIPModel, but {options.clip} is none; check the path"
        )
    return TableScoresConfig(
        from_photo=options.made_from == PHOTO,
        stanford_orb=options.suite == ORB,
        lpips_weights=options.lpips and options.lpips.resolve(),
        efficientnet_weights=installed_weights(*EFFICIENTNET_LITE0),
        inception_weights=options.fid and options.fid.resolve(),
        clip_folder=options.clip and options.clip.resolve(),
    )


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
        if options.seeds < 1:
            raise InputError(f"--seeds {options.seeds}: wanted one or more")
        self.seeds = range(options.seed, options.seed + options.seeds)
        self._config = scores_config(options)

    def subject(
        self, name: str, known: _Scored, cases: Sequence[tuple[Row, int]]
    ) -> Subject | None:
        """An object in the layout of benchmark orbits; None, and a failure, if it is damaged."""
        from stages.suites import truth_folder

        options = self._options
        try:
            folder = truth_folder(
                options.suite, options.folder, name, self.out / TRUTHS, options.size
            )
        except InputError as error:
            for row, seed in cases:
                self._fail(row, name, seed, str(error), known, "")
            return None
        return Subject(name, folder)

    def score(self, subject: Subject, row: Row, seed: int, known: _Scored, told: str) -> None:
        """Scores of a case, from the store or computed."""
        options, from_photo = self._options, self._options.made_from == PHOTO
        try:
            case = plan_case(
                subject,
                row,
                self._store,
                from_photo=from_photo,
                config=self._config,
                seed=seed,
            )
        except InputError as error:
            self._fail(row, subject, seed, str(error), known, told)
            return
        page, state = known_scores(case, self._store), "known"
        if page is None:
            reason = run_case(
                case,
                from_photo=from_photo,
                seed=seed,
                device=options.device,
                store=self._store,
                limit_s=options.limit,
            )
            page, state = known_scores(case, self._store), "computed"
            if page is None:
                reason = reason or f"{Outcome.CRASHED}: no scores in the store"
                self._fail(row, subject, seed, reason, known, told)
                return
        known.results[row.name][subject.name, seed] = page
        self._say(f"[{told}] {subject.name}, {self._called(row, seed)}: {state}")

    def write(self, known: _Scored, *, is_last: bool = False) -> None:
        """All tables of what is known by now; sets of pictures are compared once, at last."""
        suite = self._options.suite
        notes = {name: notes_for(suite, name) for name in _TABLES}
        tables = tables_of(known.results, notes)
        more = [samples_table(known.results), sets_table(known.results) if is_last else None]
        if suite == ORB:
            more.append(orb_table(known.results, known.missing, notes_for(suite, ORB)))
        tables += [table for table in more if table is not None]
        write_tables(tables, known.results, known.failures, self._told(known), self.out)

    def _told(self, known: _Scored) -> list[str]:
        """How it was measured."""
        options = self._options
        objects = dict.fromkeys(name for pages in known.results.values() for name, _ in pages)
        changed = "".join(f" --set {setting}" for setting in options.set)
        source = "true views" if options.made_from == VIEWS else "one photo each"
        return [
            f"`svim3d evaluate {options.suite} --from {options.made_from} --preset "
            f"{options.preset}{changed} --seed {options.seed} --seeds {options.seeds}`: "
            f"{len(objects)} objects "
            f"({', '.join(objects) or 'none yet'}), made of {source}.",
            "Means over objects of means over seeds of means over views inside the true mask; "
            "pictures clipped to [0, 1] and sRGB-encoded; in brackets bootstrap intervals of 95 % "
            "over objects (and their seeds), in parentheses differences to the first row, paired "
            "by object and seed. Lengths are shares of the "
            "longest side. Assets of photos are laid over the truth by the photo's view alone.",
        ]

    def _fail(
        self,
        row: Row,
        subject: Subject | str,
        seed: int,
        reason: str,
        known: _Scored,
        told: str,
    ) -> None:
        """Note a case without scores; `subject` is a name where there is no truth of it."""
        name = subject if isinstance(subject, str) else subject.name
        known.failures.append((row.name, name, seed, reason))
        last = reason.strip().splitlines()[-1]
        self._say(f"[{told}] {name}, {self._called(row, seed)}: failed: {last}", style="red")
        if self._options.suite == ORB:
            known.missing[row.name][name, seed] = self._white(subject)

    def _white(self, subject: Subject | str) -> Page | None:
        """Scores of white pictures in the place of an asset's; None without a truth."""
        if isinstance(subject, str):
            return None
        try:
            return missing_scores(subject, self._store, self._config)
        except InputError as error:
            self._say(f"{subject.name}: white pictures cannot be scored: {error}", style="red")
            return None

    def _called(self, row: Row, seed: int) -> str:
        """A row's name, with the seed where there are several."""
        return row.name if len(self.seeds) == 1 else f"{row.name}, seed {seed}"

    def _say(self, text: str, style: str | None = None) -> None:
        self._console.print(text, style=style, highlight=False, markup=False, soft_wrap=True)


_TABLES = ("materials", "views", "relighting", "geometry", "ablation", "azimuth")
