"""Functions of position: hash-grid encodings, small networks, signed-distance grids, materials."""
