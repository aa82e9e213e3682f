"""Files and texts at the package's border: read with limits and checked against dataclasses, written whole or not at all."""
