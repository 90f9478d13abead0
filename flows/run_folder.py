"""The folder of a run: products, links to every artifact, and a page saying what was done."""

import json
import os
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flows.pipeline import Pipeline, Product
from flows.plan import Plan, state_of
from stages.errors import InputError
from stages.store import Store, Stored

RUN_PAGE = "run.json"
# Copies of what the store knows of a run; the folder of a run that failed has nothing else.
RECORD_COPY, LOG_COPY = "record.json", "run.log"


def write_run_folder(
    out: Path,
    plan: Plan,
    artifacts: Mapping[str, Stored],
    store: Store,
    about: Mapping[str, Any],
) -> None:
    """Make `out` show this run and nothing of an earlier one.

    Products are copies, so that the folder can be moved and its files be opened anywhere;
    artifacts are links into the store.

    Args:
        out: folder, made if it is not there.
        plan: what was to be done.
        artifacts: by stage, what the run has.
        store: where they are.
        about: what the caller adds to `run.json`: preset, device, engine start-up, ...

    Raises:
        InputError: if the folder cannot be written, or holds what no run has put there.
    """
    require_ours(out, plan.pipeline)
    try:
        out.mkdir(parents=True, exist_ok=True)
        # First of all the mark of a run folder, in case this is killed half-way.
        if not (out / RUN_PAGE).exists():
            replace_file(out / RUN_PAGE, b"{}")
        for node in plan.pipeline.nodes:
            stored = artifacts.get(node.name)
            _link(out / node.name, store.artifact(stored.key) if stored else None)
        for product in plan.pipeline.products:
            _copy_product(out, product, artifacts)
        page = json.dumps(_page(plan, artifacts, about) | {"products": _sizes(out, plan)}, indent=1)
        replace_file(out / RUN_PAGE, page.encode())
    except OSError as error:
        raise InputError(f"the run folder {out} cannot be written: {error}") from error


def require_ours(out: Path, pipeline: Pipeline) -> None:
    """Refuse a folder in which somebody else's files would be replaced.

    Raises:
        InputError: naming them.
    """
    names = [*pipeline.names, *(product.name for product in pipeline.products)]
    others = [name for name in names if os.path.lexists(out / name)]
    is_ours = any((out / mark).exists() for mark in (RUN_PAGE, RECORD_COPY))
    if others and not is_ours:
        raise InputError(
            f"the folder {out} is no run folder, yet holds {', '.join(others)}, which this run "
            "would replace; choose another folder with -o"
        )


def _link(link: Path, target: Path | None) -> None:
    """Point `link` to a folder; a copy where the file system knows no links."""
    if link.is_symlink():
        link.unlink()
    elif link.is_dir():
        shutil.rmtree(link)
    if target is None:
        return
    try:
        link.symlink_to(os.path.relpath(target, link.parent.resolve()), target_is_directory=True)
    except OSError:
        shutil.copytree(target, link)


def _copy_product(out: Path, product: Product, artifacts: Mapping[str, Stored]) -> None:
    """Copy a file, or a folder of files; what an earlier run left under its name goes."""
    target = out / product.name
    for stage, name in product.origins:
        source = artifacts[stage].folder / name if stage in artifacts else None
        if source is not None and source.is_file():
            return replace_file(target, source.read_bytes())
        if source is not None and source.is_dir():
            shutil.rmtree(target, ignore_errors=True)
            shutil.copytree(source, target)
            return None
    if target.is_dir():
        shutil.rmtree(target)
    target.unlink(missing_ok=True)
    return None


def _sizes(out: Path, plan: Plan) -> dict[str, int]:
    """Bytes of each product that is there; of a folder, of all its files."""
    found = {product.name: out / product.name for product in plan.pipeline.products}
    return {
        name: sum(f.stat().st_size for f in (path.rglob("*") if path.is_dir() else [path]))
        for name, path in found.items()
        if path.exists()
    }


def replace_file(file: Path, content: bytes) -> None:
    """Write a file so that a reader sees the old or the new one."""
    partial = file.with_name(f".{file.name}.{os.getpid()}")
    partial.write_bytes(content)
    partial.replace(file)


def _page(plan: Plan, artifacts: Mapping[str, Stored], about: Mapping[str, Any]) -> dict[str, Any]:
    stages = {}
    for step in plan.steps:
        stored = artifacts.get(step.node.name)
        record = stored.manifest.record if stored else {}
        stages[step.node.name] = {
            "state": state_of(step, stored),
            "reason": step.reason,
            "key": step.recipe.key if step.recipe else None,
            "bytes": stored.manifest.size if stored else None,
            **{
                name: record.get(name)
                for name in ("seconds", "headline", "peak_memory_mib", "device")
            },
            "events": record.get("events", []),
        }
    return {
        "input": str(plan.source),
        "seed": plan.seed,
        "written": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        **about,
        "stages": stages,
        "config": plan.config.model_dump(mode="json"),
    }
