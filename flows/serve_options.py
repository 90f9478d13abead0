"""Options of `serve`."""

import argparse


def serve_options() -> argparse.ArgumentParser:
    """Options of `serve`; defaults are those of `flows.service.limits`."""
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument(
        "--http",
        action="store_true",
        help="take pictures over HTTP instead, without a Prefect server; needs svim3d[http]",
    )
    options.add_argument(
        "--jobs", type=_count, default=1, metavar="N", help="runs at a time (%(default)s)"
    )
    options.add_argument(
        "--device", choices=("auto", "cpu", "cuda"), default="auto", help="(%(default)s)"
    )
    limits = options.add_argument_group("with --http")
    limits.add_argument(
        "--host", default="127.0.0.1", help="address to listen on; only this machine (%(default)s)"
    )
    limits.add_argument("--port", type=_port, default=8000, help="(%(default)s)")
    for name, kind, default, metavar, purpose in (
        ("--queue", _count, 32, "N", "jobs that may wait; more are told to come back"),
        ("--max-upload-mib", _positive, 64.0, "MIB", "size of a request"),
        ("--timeout-h", _positive, 4.0, "HOURS", "in which a job must be done"),
        ("--keep-h", _positive, 72.0, "HOURS", "after which finished jobs are removed"),
    ):
        limits.add_argument(
            name, type=kind, default=default, metavar=metavar, help=f"{purpose} (%(default)s)"
        )
    return options


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"wanted 1 or more, got {text}")
    return value


def _port(text: str) -> int:
    value = int(text)
    if not 0 <= value < 1 << 16:
        raise argparse.ArgumentTypeError(f"wanted 0 to 65535, got {text}")
    return value


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"wanted a positive number, got {text}")
    return value
