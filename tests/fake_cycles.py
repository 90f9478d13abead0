"""An interpreter that plays Cycles: every picture has one colour, by light and view."""

import sys
from pathlib import Path

COVERAGE = 0.5

# Started as the real one is: NAME -I SCRIPT FOLDER. It keeps what it was given.
PLAYED = """#!{python}
import json, shutil, sys
from pathlib import Path
import numpy as np, OpenEXR
assert sys.argv[1] == "-I" and Path(sys.argv[2]).name == "cycles_scene.py", sys.argv
folder = Path(sys.argv[3])
told = json.loads((folder / "scene.json").read_text())
shutil.copytree(folder, {kept!r}, dirs_exist_ok=True)
for light in range(told["lights"]):
    for view in range(len(told["cameras"])):
        plane = np.full((told["size"], told["size"]), {coverage}, np.float32)
        colour = plane * (1 + light + 10 * view)
        channels = dict(R=colour, G=colour, B=colour, A=plane)
        header = dict(compression=OpenEXR.ZIP_COMPRESSION, type=OpenEXR.scanlineimage)
        OpenEXR.File(header, channels).write(str(folder / f"{{light}}_{{view}}.exr"))
"""


def executable(file: Path, text: str) -> Path:
    """A script that starts itself."""
    file.write_text(text)
    file.chmod(0o755)
    return file


def fake_interpreter(folder: Path) -> Path:
    """The player; what it was given last lies in `folder / "kept"` afterwards."""
    kept = str(folder / "kept")
    text = PLAYED.format(python=sys.executable, kept=kept, coverage=COVERAGE)
    return executable(folder / "player", text)
