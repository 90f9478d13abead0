"""Idempotent steps of the pipeline: artifacts in, artifact out."""
