"""Differentiable rasterisation: coverage, interpolation, silhouettes, textures.

`zbuffer.rasterize` finds the visible triangle of each pixel, `interpolation.interpolate` carries
vertex attributes to pixels, `silhouettes.antialias` makes coverage differentiable, and
`texture.sample_texture` reads textures. On the CPU each runs a numba kernel; a plain torch twin
with the same result runs on any other device.

Clip space is OpenGL's: x right, y up, visible where |x|, |y|, |z| <= w. Row 0 of an image is at the
top and pixel centres lie at half integers.
"""
