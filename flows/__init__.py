"""Orchestration: the only floor that knows Prefect and the command line."""
