"""Tiny orbit folders as a caller would pack them."""

import io
import json
import warnings
import zipfile
from pathlib import Path

import numpy as np

from svim3d.io.exr import write_exr

POSE = np.eye(4).tolist()
SIZE = 8


def exr(tmp_path: Path, height: int = SIZE, width: int = SIZE) -> bytes:
    names = ("R", "G", "B", "A", "basecolor.R", "basecolor.G", "basecolor.B")
    names += ("roughness.V", "metallic.V", "normal.X", "normal.Y", "normal.Z")
    plane = np.full((height, width), 0.5, np.float32)
    planes = {name: plane for name in names} | {"normal.X": plane * 0, "normal.Y": plane * 0}
    write_exr(tmp_path / "one.exr", planes | {"normal.Z": plane * 0 + 1})
    return (tmp_path / "one.exr").read_bytes()


def index(files: list[str], **more) -> bytes:
    camera = {"width": SIZE, "height": SIZE, "fov_deg": 33.8}
    frames = [{"file": file, "c2w": POSE} for file in files]
    return json.dumps({"camera": camera, "frames": frames, **more}).encode()


def packed(
    entries: dict[str | zipfile.ZipInfo, bytes], how: int = zipfile.ZIP_DEFLATED
) -> io.BytesIO:
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of two entries of one name
        with zipfile.ZipFile(buffer, "w", how) as archive:
            for name, content in entries.items():
                archive.writestr(name, content)
    return buffer
