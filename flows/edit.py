"""`svim3d edit`: a GLB with other materials."""

import argparse
from pathlib import Path

from rich.console import Console

from flows.job import DONE
from stages.errors import InputError


def edit(options: argparse.Namespace) -> int:
    """Write the edited asset and say what was changed beyond the wish."""
    from stages.edit import edit_asset

    source: Path = options.input
    out: Path = options.output or source.with_name(f"{source.stem}-edited.glb")
    content, notices = edit_asset(source, options.edit, mask=options.mask, record=options.replay)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        partial = out.with_name(f".{out.name}.partial")
        partial.write_bytes(content)
        partial.replace(out)
    except OSError as error:
        raise InputError(f"{out} cannot be written: {error}") from error
    console = Console()
    for notice in notices:
        console.print(notice, style="yellow", highlight=False, markup=False)
    console.print(f"{out}: {len(content) / 2**20:.2f} MiB", highlight=False)
    return DONE
