"""Other benchmarks' folders, read into the layout of benchmark orbits.

Each module knows one layout: `list_objects`, `source_files` (what an object is read from),
`read_object`, and `LOOKED_FOR`, which says in words how an object is recognised.
"""
