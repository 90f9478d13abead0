"""`svim3d serve --http`: pictures in over HTTP, assets out, by a queue of ordinary runs."""
