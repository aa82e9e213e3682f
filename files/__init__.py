"""Files and texts at the package's border: read with limits and checked against dataclasses, written whole or not at all."""

MOST_THREADS = 1024
"""Largest number of CPU threads. The constant stands here because the command line reads it without importing more."""
