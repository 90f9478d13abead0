"""The options of the commands that look after runs and the store."""

import argparse
from pathlib import Path

RUN_HELP = "id of a run or its beginning, its run folder, or that one's name"
# Variables that the options about hooks set.
ON_FAILURE, ON_END = "SVIM3D_ON_FAILURE", "SVIM3D_ON_END"
UNITS_S = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0, "w": 604_800.0}


def status_options() -> argparse.ArgumentParser:
    """Options of `status`."""
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument(
        "run", nargs="?", metavar="RUN", help=f"{RUN_HELP} (a table of the newest runs)"
    )
    options.add_argument("--all", action="store_true", help="a table of all runs")
    options.add_argument(
        "--failed",
        action="store_true",
        help="only those that resume --all-failed would carry out again; the exit code is 1 if "
        "there are any",
    )
    return options


def hook_options() -> argparse.ArgumentParser:
    """Options of the commands that carry out runs: who is told how they end."""
    options = argparse.ArgumentParser(add_help=False)
    hooks = options.add_argument_group(
        "when a run ends",
        "a COMMAND gets what there is to say as JSON and in variables (SVIM3D_RUN, SVIM3D_STATE, "
        "SVIM3D_ERROR, ...), a URL (http, https) is posted the JSON",
    )
    hooks.add_argument(
        "--on-failure",
        metavar="COMMAND|URL",
        help=f"tell of runs that failed or were cancelled (${ON_FAILURE})",
    )
    hooks.add_argument("--on-end", metavar="COMMAND|URL", help=f"tell of all runs (${ON_END})")
    return options


def resume_options() -> argparse.ArgumentParser:
    """Options of `resume`."""
    options = argparse.ArgumentParser(add_help=False)
    which = options.add_mutually_exclusive_group(required=True)
    which.add_argument("run", nargs="?", metavar="RUN", help=RUN_HELP)
    which.add_argument(
        "--all-failed",
        action="store_true",
        help="all that failed, died or were cancelled, one after the other",
    )
    return options


def logs_options() -> argparse.ArgumentParser:
    """Options of `logs`."""
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument("run", metavar="RUN", help=RUN_HELP)
    options.add_argument("--follow", action="store_true", help="until the run ends")
    return options


def store_options(shared: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Options of the `store` actions, each with those that all commands share."""
    options = argparse.ArgumentParser(add_help=False)
    actions = options.add_subparsers(
        dest="action", metavar="ACTION", title="actions", required=True, prog="svim3d store"
    )
    ls, verify, gc, export, take = (
        actions.add_parser(
            name,
            parents=[shared],
            help=purpose,
            description=purpose[0].upper() + purpose[1:] + ".",
        )
        for name, purpose in (
            ("ls", "list artifacts, the newest first, and what each stage takes up"),
            ("verify", "hash every file; the exit code is 1 if anything is damaged"),
            ("gc", "remove old artifacts that no run needs, and what killed runs left"),
            ("export", "write a run's artifacts, page and log into one file"),
            ("import", "take up what export wrote, after checking all of it"),
        )
    )
    ls.add_argument("--all", action="store_true", help="every artifact, not only the newest")
    verify.add_argument(
        "--repair", action="store_true", help="set damaged artifacts aside, to be computed anew"
    )
    gc.add_argument(
        "--keep-last",
        type=_count,
        default=1,
        metavar="N",
        help="keep what the newest N different runs of each input need (%(default)s)",
    )
    gc.add_argument(
        "--older-than",
        type=duration_s,
        default="30d",
        metavar="AGE",
        help="remove only what is older, like 12h, 30d or 2w (%(default)s)",
    )
    gc.add_argument("--dry-run", action="store_true", help="say what would go; remove nothing")
    for parser in (export, take):
        parser.add_argument("file", type=Path, metavar="FILE", help="of the archive, like RUN.tar")
    export.add_argument("run", metavar="RUN", help=RUN_HELP)
    return options


def duration_s(text: str) -> float:
    """Seconds of `90s`, `12h`, `30d` or `2w`.

    Raises:
        argparse.ArgumentTypeError: the text is none of these.
    """
    number, unit = text[:-1], text[-1:]
    if not (number.isdecimal() and unit in UNITS_S):
        raise argparse.ArgumentTypeError(f"wanted an age like 12h, 30d or 2w, got {text!r}")
    return int(number) * UNITS_S[unit]


def _count(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"wanted a number of runs, 0 or more, got {text!r}")
    return int(text)
