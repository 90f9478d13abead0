"""A process of its own for xatlas, so that a call that does not end can be ended.

Its argument is the seconds after which it ends itself: whoever started it may be dead by then.
Reads a mesh from standard input and writes its atlas to standard output, both as raw little-endian
numbers (see `svim3d.mesh.atlas`). Imports nothing heavy: it starts in about 0.2 s.
"""

import signal
import sys

import numpy as np
import xatlas


def main() -> None:
    """Unwrap one mesh."""
    # The kernel's alarm also ends a call into compiled code.
    signal.alarm(int(sys.argv[1]))
    content = sys.stdin.buffer.read()
    vertex_count, face_count, resolution = np.frombuffer(content, "<i4", 3)
    vertices = np.frombuffer(content, "<f4", 3 * vertex_count, 12).reshape(-1, 3)
    faces = np.frombuffer(content, "<u4", 3 * face_count, 12 + vertices.nbytes).reshape(-1, 3)
    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices, faces)
    packing = xatlas.PackOptions()
    packing.resolution = int(resolution)  # charts are stretched to whole texels of this
    atlas.generate(xatlas.ChartOptions(), packing)
    source, indices, uv = atlas[0]
    # Back to texels: uv are divided by a width and a height that differ.
    pixels = uv * np.array([atlas.width, atlas.height], np.float32)
    header = np.array([len(source)], "<i4")
    for array, kind in ((header, "<i4"), (source, "<u4"), (indices, "<u4"), (pixels, "<f4")):
        sys.stdout.buffer.write(np.ascontiguousarray(array, kind).tobytes())


if __name__ == "__main__":
    main()
