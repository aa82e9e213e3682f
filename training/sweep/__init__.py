"""Several trainings that belong together: run on the GPUs there are, gauged, compared."""
