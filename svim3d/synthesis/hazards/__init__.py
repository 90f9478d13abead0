"""Hazards: what methods of this kind fail at, made to measure and with its truth."""
