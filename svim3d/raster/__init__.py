"""Differentiable rasterisation of triangle meshes, on the CPU (numba) and in plain torch."""
