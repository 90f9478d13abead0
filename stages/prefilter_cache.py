"""Prefilter operators on disk: computed once, read by every stage and every run.

A file is named after all that its content depends on: the spec, our code that computes it and the
libraries that do the arithmetic. So a stale file is never read, and several processes that compute
the same operator write the same bytes; the last one wins. Whatever is wrong with the folder or a
file costs time and nothing else.
"""

import functools
import logging
import os
import tempfile
from dataclasses import asdict
from pathlib import Path

from stages.keys import code_digests, digest_json, library_versions
from svim3d.io.weights import load_sealed, save_sealed
from svim3d.shading.prefilter import PyramidOperator
from svim3d.shading.prefilter_spec import PrefilterMode, PrefilterProfile, PrefilterSpec

log = logging.getLogger(__name__)

CODE = PyramidOperator.__module__


@functools.lru_cache(maxsize=4)
def cached_operator(
    folder: Path,
    size: int,
    mode: PrefilterMode = "exact",
    profile: PrefilterProfile = "optimisation",
) -> PyramidOperator:
    """The operator of a spec from `folder`, or computed and left there.

    Args:
        folder: derived data that runs share; made if it is missing.
        size: side of the octahedral map, texels.
        mode: see `PrefilterSpec`.
        profile: see `PrefilterSpec`.

    Raises:
        ValueError: see `PrefilterSpec`.
    """
    spec = PrefilterSpec(size, mode, profile)
    file = operator_file(folder, spec)
    operator = _read(file, spec)
    if operator is None:
        operator = PyramidOperator.build(size, mode, profile)
        _publish(file, operator)
    return operator


def operator_file(folder: Path, spec: PrefilterSpec) -> Path:
    """Where the operator of a spec lies."""
    recipe = {
        "spec": asdict(spec),
        "code": code_digests(CODE),
        "versions": library_versions(),
    }
    name = f"{spec.profile}-{spec.mode}-{spec.size}-{digest_json(recipe)[:32]}.safetensors"
    return folder / "prefilter" / name


def _read(file: Path, spec: PrefilterSpec) -> PyramidOperator | None:
    """What the file holds, or None if it is missing or damaged."""
    if not file.exists():
        return None
    try:
        return PyramidOperator.from_tensors(spec, load_sealed(file))
    except Exception as error:  # of any kind: a damaged file costs time, nothing else
        log.warning("prefilter %s is unreadable (%s): computing it anew", file, error)
        return None


def _publish(file: Path, operator: PyramidOperator) -> None:
    """Put the operator into the folder in one step, if the folder can be written."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=file.parent, prefix=file.stem, suffix=".tmp")
        os.close(handle)
        temporary = Path(name)
        try:
            save_sealed(temporary, operator.to_tensors())
            temporary.replace(file)
        finally:
            temporary.unlink(missing_ok=True)
    except Exception as error:  # of any kind: a full disk must not end a run that needs no disk
        log.warning("prefilter %s was not stored (%s)", file, error)
