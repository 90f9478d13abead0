"""Stands for a run: writes what a run writes, at once; its first argument says how it behaves."""

import json
import signal
import sys
import time
from pathlib import Path

QUICK, SLOW, BAD, STUBBORN, SILENT = range(5)
GLB = b"glTF" + bytes(range(200))


def main(behaviour: int, source: Path, out: Path) -> int:
    print("prepare: computing (nothing there)", flush=True)
    print("prepare: 1.0 s, square of 576 px", flush=True)
    print(f"prepare: no network in {out}: took the plain background", flush=True)
    if behaviour == STUBBORN:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    if behaviour in (SLOW, STUBBORN):
        print("nerf: computing (nothing there)", flush=True)
        (out.parent / "starts.txt").open("a").write("x")
        time.sleep(60)
    if behaviour == BAD:
        print("prepare: InputError: not that", flush=True)
        print(f"svim3d: {source}: wanted an object, got none; take another photo", file=sys.stderr)
        return 2
    if behaviour == SILENT:
        return 1
    out.mkdir()
    (out / "asset.glb").write_bytes(GLB)
    (out / "preview.png").write_bytes(b"preview")
    page = {
        "input": str(source.resolve()),
        "stages": {"prepare": {"state": "computed", "events": []}},
        "config": {"generation": {"model": str(source.resolve())}},
    }
    (out / "run.json").write_text(json.dumps(page))
    print("prepare: cached, square of 576 px")
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3])))
