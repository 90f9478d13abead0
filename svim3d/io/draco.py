"""The Draco door: triangles in a few bytes each, as KHR_draco_mesh_compression has them.

Source: Google Draco 1.5, edgebreaker connectivity with parallelogram prediction.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MISSING = "Draco compression needs DracoPy, which is not installed; pip install 'svim3d[draco]'"
POSITION_BITS, UV_BITS, NORMAL_BITS = 14, 14, 10  # 14 bits: 1/16384 of the longest side
LEVEL = 7  # of 10; higher ones gain less than 1 % and open more slowly
COLOUR_ID = 9  # of the generic attribute, apart from those that Draco numbers itself
TYPES = {0: "POSITION", 1: "NORMAL", 3: "TEXCOORD_0", 4: "COLOR_0"}  # Draco's attribute types


@dataclass(frozen=True)
class DracoMesh:
    """A compressed mesh and what its decoder makes of it: vertices come in another order.

    Attributes:
        content: compressed.
        ids: Draco's number of each glTF attribute.
        vertices: decoded positions.
        faces: number of triangles.
    """

    content: bytes
    ids: dict[str, int]
    vertices: NDArray[np.float32]
    faces: int


def compress(
    vertices: NDArray[np.float32],
    faces: NDArray[np.uint32],
    normals: NDArray[np.float32],
    uv: NDArray[np.float32] | None,
    colours: NDArray[np.uint16] | None,
) -> DracoMesh:
    """Quantise and compress; equal input gives equal bytes.

    Args:
        vertices: [N, 3].
        faces: [F, 3].
        normals: [N, 3], unit.
        uv: [N, 2].
        colours: [N, 3], kept as they are.

    Raises:
        ValueError: DracoPy is not installed.
    """
    try:
        import DracoPy
    except ImportError as error:
        raise ValueError(MISSING) from error
    content: bytes = DracoPy.encode(
        vertices,
        faces,
        quantization_bits=POSITION_BITS,
        compression_level=LEVEL,
        normals=normals.astype(np.float64),  # the wrapper takes no others
        normal_quantization_bits=NORMAL_BITS,
        tex_coord=None if uv is None else uv.astype(np.float64),
        tex_coord_quantization_bits=None if uv is None else UV_BITS,
        generic_attributes=None if colours is None else {COLOUR_ID: colours},
    )
    decoded = DracoPy.decode(content)
    ids = {TYPES[a["attribute_type"]]: int(a["unique_id"]) for a in decoded.attributes}
    return DracoMesh(content, ids, np.asarray(decoded.points, np.float32), len(decoded.faces))
