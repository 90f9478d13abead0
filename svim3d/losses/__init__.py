"""Distances of pictures that optimisations minimise."""
