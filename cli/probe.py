"""Try drivers and OpenGL, which may hang or kill their process, in a child process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any

PATIENCE = 120.0
"""Longest time that a child process may take [s]."""


def ask(program: str, **environment: str) -> tuple[Any, str]:
    """Run a Python program in a child process, with more environment variables.

    Returns:
        The JSON that it prints on its last line, and an empty text; or None, and a sentence on the failure.
    """
    try:
        command, variables = [sys.executable, "-c", program], {**os.environ, **environment}
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=PATIENCE, env=variables, check=False
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
