"""Files and texts at the package's border: read with limits and checked against dataclasses, written whole or not at all."""

MOST_THREADS = 1024
"""CPU threads: more than any machine has use for. It stands here because the command line looks at it without importing more."""
