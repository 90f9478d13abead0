"""The folder of a run: products, links to every artifact, and a page saying what was done."""

import json
import os
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flows.pipeline import Product
from flows.plan import Plan, state_of
from stages.errors import InputError
from stages.store import Store, Stored

RUN_PAGE = "run.json"


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
        InputError: if the folder cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        for node in plan.pipeline.nodes:
            stored = artifacts.get(node.name)
            _link(out / node.name, store.artifact(stored.key) if stored else None)
        for product in plan.pipeline.products:
            _copy_product(out, product, artifacts)
        page = json.dumps(_page(plan, artifacts, about), indent=1)
        _replace(out / RUN_PAGE, page.encode())
    except OSError as error:
        raise InputError(f"the run folder {out} cannot be written: {error}") from error


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
    for stage, name in product.origins:
        if stage in artifacts and (file := artifacts[stage].folder / name).is_file():
            _replace(out / product.name, file.read_bytes())
            return
    (out / product.name).unlink(missing_ok=True)


def _replace(file: Path, content: bytes) -> None:
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
