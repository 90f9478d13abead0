"""Writing a run's report into its folder: at the end of the run, or again when it is asked for."""

import logging
from pathlib import Path

from flows.pipeline import REPORT
from flows.report.evidence import gather
from flows.report.page import run_page
from flows.report.pictures import NONE, obtain_pictures
from flows.run_folder import replace_file
from flows.run_records import RunRecord
from stages.settings.gallery import GalleryConfig
from stages.store import Store

log = logging.getLogger(__name__)


def write_report(
    record: RunRecord, store: Store, file: Path, config: GalleryConfig | None = None
) -> None:
    """Write the page of a run, finished or not.

    Args:
        record: the run.
        store: where its artifacts are.
        file: the page.
        config: how much its pictures may take.
    """
    evidence = gather(record, store)
    try:
        pictures = obtain_pictures(
            store, evidence.artifacts, Path(record.source), config or GalleryConfig()
        )
    except Exception as error:  # of any kind: figures and causes are worth a page without pictures
        log.warning("the report has no pictures: %s", error)
        pictures = NONE
    replace_file(file, run_page(evidence, pictures).encode())


def report_quietly(record: RunRecord, store: Store) -> None:
    """Write a run's report into its folder if that can be; a run does not fail for its sake."""
    try:
        write_report(record, store, Path(record.folder) / REPORT)
    except Exception as error:  # of any kind, see above
        log.warning("no report was written: %s", error)
