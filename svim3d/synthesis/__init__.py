"""Invented objects, materials, lights and camera paths: what a model is trained on."""
