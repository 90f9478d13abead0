"""Orbits in our own layout: each a folder with `orbit.json`."""

from pathlib import Path

from svim3d.io.orbit import INDEX

LOOKED_FOR = f"OBJECT/{INDEX}"


def list_objects(folder: Path) -> list[str]:
    """Names of the orbit folders."""
    return sorted(file.parent.name for file in folder.glob(f"*/{INDEX}"))
