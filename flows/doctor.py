"""`svim3d doctor`: what this machine offers, what is installed, how the store is."""

import importlib.metadata
import importlib.util
import os
import platform
import shutil
from collections.abc import Iterator
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from stages.store import Store

DONE, FAILED = 0, 1
LIBRARIES = ("torch", "numpy", "numba", "OpenEXR", "pymeshlab", "xatlas", "prefect")
# What the pipeline can do without, by module name.
OPTIONAL = {
    "mitsuba": "svim3d relight --engine path",
    "imageio_ffmpeg": "svim3d relight --turntable mp4, unless ffmpeg is on the path",
    "onnxruntime": "svim3d run on photos with any background: a matting network",
    "matplotlib": "charts of the benchmarks",
    "pytest": "the tests",
}


def doctor(root: Path) -> int:
    """Print the findings; returns 1 if something will keep a run from working."""
    table = Table(box=None, pad_edge=False, show_header=False)
    problems = []
    for name, finding, is_fine in [*_machine(root), *_installation(), *_store(Store(root))]:
        table.add_row(name, escape(finding) if is_fine else f"[red]{escape(finding)}")
        if not is_fine:
            problems.append(name)
    console = Console()
    console.print(table)
    console.print(f"to mend: {', '.join(problems)}" if problems else "all is well")
    return FAILED if problems else DONE


def _machine(root: Path) -> Iterator[tuple[str, str, bool]]:
    """Name, finding and whether it is fine."""
    import torch

    has_cuda = torch.cuda.is_available()
    yield "device", torch.cuda.get_device_name() if has_cuda else "cpu", True
    yield "cores", f"{os.cpu_count()}, torch uses {torch.get_num_threads()}", True
    memory_mib = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**20
    yield "memory", f"{memory_mib / 1024:.1f} GiB", True
    existing = next(p for p in (root.resolve(), *root.resolve().parents) if p.exists())
    free_mib = shutil.disk_usage(existing).free / 2**20
    yield "disk", f"{free_mib / 1024:.1f} GiB free at {existing}", True
    yield "system", f"{platform.platform()}, Python {platform.python_version()}", True


def _installation() -> Iterator[tuple[str, str, bool]]:
    for name in LIBRARIES:
        try:
            yield name, importlib.metadata.version(name), True
        except importlib.metadata.PackageNotFoundError:
            yield name, "not installed; run pip install -c constraints.txt -e .", False
    for name, purpose in OPTIONAL.items():
        is_there = importlib.util.find_spec(name) is not None
        yield name, "installed" if is_there else f"not installed (needed for {purpose})", True


def _store(store: Store) -> Iterator[tuple[str, str, bool]]:
    """State of every artifact, by its content."""
    keys = store.keys()
    health = {key: store.check(key) for key in keys}
    size = sum(h.stored.manifest.size for h in health.values() if h.stored)
    yield "store", f"{store.root}: {len(keys)} artifacts, {size / 2**20:.0f} MiB", True
    for key, found in health.items():
        if found.damage:
            yield f"artifact {key[:8]}", f"{found.damage}; the next run computes it anew", False
    work = store.root / "work"
    unfinished = len(list(work.iterdir())) if work.is_dir() else 0
    if unfinished:
        yield "unfinished", f"{unfinished} interrupted stages; the same run takes them up", True
