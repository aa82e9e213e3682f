"""Programs that may hang or take their process with them, drivers and OpenGL, are tried in a child process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any

PATIENCE = 120.0
"""Longest time that a child process may take [s]."""


def ask(program: str, **environment: str) -> tuple[Any, str]:
    """Run a Python program in a child process.

    Args:
        environment: variables beside those of this process.

    Returns:
        What it prints as JSON on its last line, and an empty text; or None, and what went wrong.
    """
    try:
        done = subprocess.run(
            [sys.executable, "-c", program],
            capture_output=True,
            text=True,
            errors="replace",
            timeout=PATIENCE,
            env={**os.environ, **environment},
        )
    except subprocess.TimeoutExpired:
        return None, f"no answer within {PATIENCE:g} s"
    lines = [line for line in (done.stdout if done.returncode == 0 else done.stderr).splitlines() if line.strip()]
    if done.returncode != 0:
        return None, lines[-1] if lines else f"ended with exit code {done.returncode}"
    try:
        return json.loads(lines[-1] if lines else ""), ""
    except json.JSONDecodeError:
        return None, f"answered {lines[-1:]}"
