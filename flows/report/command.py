"""`svim3d report`: the page of a run, written again."""

import argparse
from pathlib import Path

from rich.console import Console

from flows.pipeline import REPORT
from flows.report.writing import write_report
from flows.run_records import RunIndex
from stages.errors import InputError
from stages.settings.gallery import GalleryConfig
from stages.store import Store

DONE = 0


def report(options: argparse.Namespace) -> int:
    """Write the report of a run, finished or failed.

    Raises:
        InputError: there is no such run, or the page cannot be written.
    """
    record = RunIndex(options.store).find(options.run)
    file = Path(options.output or Path(record.folder) / REPORT)
    limit = {} if options.most_mib is None else {"most_model_mib": options.most_mib}
    try:
        config = GalleryConfig(**limit)
    except ValueError as error:
        raise InputError(f"--most-mib {options.most_mib}: wanted 0.1 to 64") from error
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_report(record, Store(options.store), file, config)
    except OSError as error:
        raise InputError(f"the report cannot be written: {error}; give a file with -o") from error
    size = file.stat().st_size / 2**20
    Console().print(f"{file}: {size:.1f} MiB", highlight=False, markup=False, soft_wrap=True)
    return DONE
