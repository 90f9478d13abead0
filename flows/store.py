"""`svim3d store`: what the store holds, whether it is sound, what may go, what moves elsewhere."""

import argparse
import contextlib
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import replace

from rich.console import Console
from rich.markup import escape
from rich.progress import track
from rich.table import Table

from flows.run_records import RunIndex, RunRecord, worth_keeping
from flows.runs import in_short, table_console
from stages.manifest import Manifest
from stages.store import Store
from stages.store_archive import RUN_LOG, RUN_PAGE, export_artifacts, import_artifacts
from stages.store_cleaning import collect_garbage

EXIT_DONE, EXIT_FAILED = 0, 1
SHOWN = 40  # rows, without --all


def store(options: argparse.Namespace) -> int:
    """Do what the action says; see `svim3d store --help`."""
    actions = {"ls": ls, "verify": verify, "gc": gc, "export": export, "import": take_up}
    return actions[options.action](options)


def ls(options: argparse.Namespace) -> int:
    """List artifacts, the newest first, and what each stage takes up."""
    console = table_console()
    found = list(_dated(Store(options.store)))
    shown = found if options.all else found[:SHOWN]
    table = Table("key", "stage", box=None, pad_edge=False)
    for column in ("MiB", "age", "seconds"):
        table.add_column(column, justify="right")
    table.add_column("result", no_wrap=True)
    for changed, manifest in shown:
        table.add_row(
            manifest.recipe.key[:8],
            escape(manifest.recipe.stage),
            _mib(manifest.size),
            in_short(time.time() - changed),
            f"{manifest.record.get('seconds', 0.0):.1f}",
            escape(str(manifest.record.get("headline", ""))),
        )
    console.print(table)
    if len(shown) < len(found):
        console.print(f"the newest {len(shown)} are shown; --all shows all", highlight=False)
    counts: Counter[str] = Counter()
    sizes: defaultdict[str, int] = defaultdict(int)
    for _, manifest in found:
        counts[manifest.recipe.stage] += 1
        sizes[manifest.recipe.stage] += manifest.size
    totals = Table("stage", box=None, pad_edge=False)
    for column in ("artifacts", "MiB"):
        totals.add_column(column, justify="right")
    for stage in sorted(sizes, key=lambda stage: -sizes[stage]):
        totals.add_row(escape(stage), str(counts[stage]), _mib(sizes[stage]))
    totals.add_row("all", str(len(found)), _mib(sum(sizes.values())))
    console.print(totals)
    return EXIT_DONE


def verify(options: argparse.Namespace) -> int:
    """Hash every file; returns 1 if anything is, or was, damaged."""
    console = Console()
    found = Store(options.store, say=lambda text: console.print(text, highlight=False))
    keys, size, damaged = found.keys(), 0, 0
    for key in track(
        keys, "verifying", console=console, transient=True, disable=not console.is_terminal
    ):
        health = found.check(key)
        if health.stored is not None:
            size += health.stored.manifest.size
        if health.state != "corrupted":
            continue
        damaged += 1
        if options.repair:
            found.quarantine(key)
        else:
            console.print(
                f"artifact {key[:8]} is damaged: {health.damage}",
                style="red",
                highlight=False,
                markup=False,
            )
    advice = "; --repair sets them aside" if damaged and not options.repair else ""
    console.print(
        f"{len(keys)} artifacts, {_mib(size)} MiB are sound, {damaged} damaged{advice}",
        highlight=False,
    )
    return EXIT_FAILED if damaged else EXIT_DONE


def gc(options: argparse.Namespace) -> int:
    """Remove what is old and not needed, and say what went, or would go."""
    console, index = Console(), RunIndex(options.store)
    kept: list[RunRecord] = []

    def needed() -> frozenset[str]:
        kept[:] = worth_keeping(index.records(), options.keep_last)
        return frozenset().union(*(record.keys for record in kept))

    removed = collect_garbage(
        Store(options.store),
        needed,
        older_than_s=options.older_than,
        dry_run=options.dry_run,
    )
    for removal in removed if options.dry_run else ():
        console.print(
            f"{removal.kind:20} {_mib(removal.size):>10} MiB  {removal.path.name}",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
    stay = {record.id for record in kept}
    forgotten = [
        record
        for record in index.records()
        if record.id not in stay and time.time() - record.changed > options.older_than
    ]
    for record in forgotten if not options.dry_run else ():
        index.forget(record.id)
    kinds = Counter(removal.kind for removal in removed)
    kinds["run page"] = len(forgotten)
    counts = ", ".join(f"{n} {kind}{'s' if n > 1 else ''}" for kind, n in kinds.items() if n)
    size = sum(removal.size for removal in removed)
    would = "would be " if options.dry_run else ""
    console.print(
        f"{_mib(size)} MiB {would}removed ({size} bytes): {counts or 'nothing'}",
        highlight=False,
        soft_wrap=True,
    )
    return EXIT_DONE


def export(options: argparse.Namespace) -> int:
    """Write a run's artifacts, page and log into one tar."""
    console, index = Console(), RunIndex(options.store)
    record = index.find(options.run)
    pages = {RUN_PAGE: record.as_bytes()}
    if (log := index.log(record.id)).exists():
        pages[RUN_LOG] = log.read_bytes()
    wanted = [stage.key for stage in record.stages.values() if stage.key]
    missing = export_artifacts(Store(options.store), wanted, pages, options.file)
    for name, stage in record.stages.items():
        if stage.key in missing:
            console.print(f"{name} is not in the store", style="yellow", highlight=False)
    size = options.file.stat().st_size
    console.print(
        f"{options.file}: {len(wanted) - len(missing)} artifacts, {_mib(size)} MiB",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )
    return EXIT_DONE


def take_up(options: argparse.Namespace) -> int:
    """Publish what an exported tar holds, and list its run."""
    imported = import_artifacts(Store(options.store), options.file, check_page=RunRecord.parse)
    told = ""
    if RUN_PAGE in imported.pages:
        told = f" of {_enter(imported.pages, RunIndex(options.store))}"
    Console().print(
        f"{options.file}: {len(imported.new)} artifacts{told} are new, "
        f"{len(imported.kept)} were there",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )
    return EXIT_DONE


def _enter(pages: dict[str, bytes], index: RunIndex) -> str:
    """List an imported run, unless it is listed already; gives its id."""
    record = RunRecord.parse(pages[RUN_PAGE])
    if not index.page(record.id).exists():
        # Commands of others are not carried out, and their folders are not here.
        index.write(replace(record, command=(), folder=""))
        if RUN_LOG in pages:
            index.log(record.id).write_bytes(pages[RUN_LOG])
    return record.id


def _dated(found: Store) -> Iterator[tuple[float, Manifest]]:
    """Readable manifests, newest first, each with the second in which it was published."""
    dated = []
    for key in found.keys():  # noqa: SIM118 (a store is no mapping)
        with contextlib.suppress(FileNotFoundError):  # replaced at this moment
            dated.append((found.artifact(key).stat().st_mtime, key))
    for changed, key in sorted(dated, reverse=True):
        with contextlib.suppress(ValueError):
            yield changed, Manifest.read(found.artifact(key))


def _mib(size: int) -> str:
    return f"{size / 2**20:.1f}"
