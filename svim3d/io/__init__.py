"""Doors to the file system, one per library; imported by stages and flows only."""
