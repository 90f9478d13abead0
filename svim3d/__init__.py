"""svim3d, the library: tensors in, tensors out. Stages and flows build on it, never the reverse."""
