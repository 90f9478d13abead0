"""Where field, mesh, light and camera meet."""
