"""Record the origin of a result: programs, machine, command and digests of the files that were read."""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, distributions, version
from pathlib import Path
from typing import Any

from ..version import __version__

PACKAGES = ("mujoco", "mujoco-warp", "newton", "warp-lang", "torch", "numpy", "rsl-rl-lib", "onnxruntime")
OPTIONAL = ("drake", "ovphysx", "ovstage")
"""Packages of engines that extras install; named where they are installed."""
_GROUPS = "gaitgauge."
_JUDGING = ("backends", "files", "gauge", "policy", "robots", "terrains")
_ROOT = Path(__file__).resolve().parents[1]


def provenance(
    *,
    command: Sequence[str],
    device: str = "cpu",
    threads: int = 1,
    digests: Mapping[str, str] | None = None,
    **measured: Any,
) -> dict[str, Any]:
    """Return the origin of a result as plain data.

    Args:
        digests: SHA-256 by the name of its file's role (``policy``, ``robot``, ``suite``).
        measured: entries of the caller's own, such as ``seconds``.
    """
    return {
        "versions": versions(),
        "commit": commit(),
        "plugins": plugins(),
        "digests": dict(digests or {}),
        "command": shlex.join(map(str, command)),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "host": platform.node(),
        "machine": f"{platform.machine()}, {os.cpu_count()} CPUs, {platform.system()} {platform.release()}",
        "processor": processor(),
        "device": device_name(device),
        "threads": threads,
    } | measured


def without_place(found: Mapping[str, Any]) -> dict[str, Any]:
    """Return provenance for publication: without the machine's name and, since commands hold paths, without the command."""
    return {name: value for name, value in found.items() if name not in ("host", "command")}


@cache
def versions() -> dict[str, str]:
    """Return the versions of the programs that results depend on."""
    found = {"python": platform.python_version(), "gaitgauge": __version__}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    for package in OPTIONAL:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


@cache
def source_digest() -> str:
    """Return the SHA-256, hexadecimal, over the source of all packages that a score depends on."""
    return digest(path for package in _JUDGING for path in sorted((_ROOT / package).rglob("*.py")))


@cache
def commit() -> str | None:
    """Return the commit of the running source, with ``-dirty`` after changes; None for an installed package."""
    if not (_ROOT / ".git").exists():
        return None
    ask = ["git", "-C", str(_ROOT), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        return subprocess.run(ask, capture_output=True, text=True, timeout=10, check=True).stdout.strip() or None
    except (OSError, subprocess.SubprocessError):
        return None


@cache
def plugins() -> dict[str, str]:
    """Return the installed plug-ins: ``value (distribution version)`` by ``group:name``."""
    found = {
        f"{entry.group}:{entry.name}": f"{entry.value} ({package.metadata['Name']} {package.version})"
        for package in distributions()
        for entry in package.entry_points
        if entry.group.startswith(_GROUPS)
    }
    return dict(sorted(found.items()))


@cache
def processor() -> str:
    """Return the CPU's model, as the system names it."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def device_name(device: str) -> str:
    """Return a torch device's name for people."""
    if device.startswith("cuda"):
        import torch

        return torch.cuda.get_device_name(device)
    return device


def digest(paths: Iterable[Path], *more: str) -> str:
    """Return the SHA-256, hexadecimal, over the contents of files in order and texts; raise ``OSError`` where a file is unreadable."""
    total = hashlib.sha256()
    for path in paths:
        with path.open("rb") as file:
            total.update(hashlib.file_digest(file, "sha256").digest())
    for text in more:
        total.update(hashlib.sha256(text.encode("utf-8", "backslashreplace")).digest())
    return total.hexdigest()
