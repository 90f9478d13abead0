"""Presets as YAML: only differences from the defaults in `stages.settings`."""
