"""`svim3d serve`: wait for work and do it."""

import argparse
import importlib.util

from stages.errors import InputError

NEEDED = ("fastapi", "uvicorn", "python_multipart")


def serve(options: argparse.Namespace) -> int:
    """Start the service, or serve the deployments.

    Raises:
        InputError: what it is made of is not installed, or no Prefect server is there.
    """
    if not options.http:
        from flows.serve_deployments import serve_deployments

        return serve_deployments(options)
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"svim3d serve --http needs {', '.join(missing)}: pip install 'svim3d[http]'"
        )
    from flows.service.serve import serve as serve_http

    return serve_http(options)
