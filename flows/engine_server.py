"""The server process of `flows.engine`: serves Prefect's API until its parent is gone."""

import os
import sys
import threading

import uvicorn


def main() -> None:
    """Serve on the listening socket whose descriptor is the first argument."""
    config = uvicorn.Config(
        "prefect.server.api.server:create_app",
        factory=True,
        fd=int(sys.argv[1]),
        log_level="error",
        lifespan="on",
    )
    server = uvicorn.Server(config)
    threading.Thread(target=_stop_with_parent, args=(server,), daemon=True).start()
    server.run()
    # Everything is written and closed; tearing the interpreter down would take 2 s more.
    os._exit(0)


def _stop_with_parent(server: uvicorn.Server) -> None:
    """Wait for the end of standard input, which comes however the parent ends."""
    sys.stdin.buffer.read()
    server.should_exit = True


if __name__ == "__main__":
    main()
