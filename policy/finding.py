"""Finds the policies that have names."""

from __future__ import annotations

import re
from pathlib import Path

LOG_ROOT = Path("logs/rsl_rl")
"""Folder of training runs: ``<LOG_ROOT>/<experiment>/<run>/``."""
SHIPPED = Path(__file__).parent / "pretrained"
"""The folder of the policies that ship with the project, ``<name>.gauge.pt``."""
PRETRAINED = SHIPPED / "go2.gauge.pt"
"""The one that ``pretrained`` stands for."""
OF_RUNS = ("latest", "best")
"""Names of checkpoints of the last training run."""
_ENDING = ".gauge.pt"
_RANK_FILE = re.compile(r"(model_\d+)\.rank\d+\.pt")


def shipped_policies() -> dict[str, Path]:
    """Return the files that ship, by name: ``pretrained``, and ``pretrained-<name>`` for every other file of the folder."""
    others = sorted(path for path in SHIPPED.glob(f"*{_ENDING}") if path != PRETRAINED)
    return {"pretrained": PRETRAINED} | {f"pretrained-{path.name.removesuffix(_ENDING)}": path for path in others}


def policy_names() -> tuple[str, ...]:
    """Return the names that ``find_policy`` takes beside paths."""
    return (*OF_RUNS, *shipped_policies())


def find_policy(path_or_name: str | Path) -> Path:
    """Return the file behind a path or a name. A file that exists wins over a name.

    Args:
        path_or_name: a file; or ``latest`` (last checkpoint of the last training run), ``best`` (the last run's best
            checkpoint), ``pretrained`` (the Go2's that ships with the project), ``pretrained-go1`` … (the others that do).

    Raises:
        PolicyError: there is none.
    """
    from .base import PolicyError  # waits for torch, which a list of names need not

    path = Path(path_or_name)
    name = str(path_or_name)
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (OSError, ValueError) as error:  # a name that is too long, holds a null character, leads in circles
        raise PolicyError(f"'{name}' cannot be read: {getattr(error, 'strerror', None) or error}") from error
    names = policy_names()
    if name in names and not path.is_file():
        found = _of_runs(name) if name in OF_RUNS else shipped_policies()[name]
        if found is None:
            wanted = "best.pt" if name == "best" else "model_<iteration>.pt"
            raise PolicyError(
                f"there is no policy '{name}': no run in '{LOG_ROOT}/<experiment>/<run>/' has a {wanted}; give a path"
            )
        if not found.is_file():
            raise PolicyError(f"no {name} policy ships with this installation (looked for '{found}'); give a path")
        return found
    if path.is_dir():
        raise PolicyError(f"'{name}' is a folder; name a policy file in it, or one of: {', '.join(names)}")
    if not path.exists():
        raise PolicyError(f"there is no policy file '{name}'; give the path of a file, or one of: {', '.join(names)}")
    if not path.is_file():
        raise PolicyError(f"'{name}' is not a regular file")
    if (part := _RANK_FILE.fullmatch(path.name)) and (whole := path.with_name(f"{part[1]}.pt")).is_file():
        raise PolicyError(
            f"'{name}' is what one process of a training on several GPUs adds to its checkpoint; give '{whole}'"
        )
    return path


def latest_checkpoint(run: Path) -> Path | None:
    """Return the ``model_<iteration>.pt`` of the highest iteration in a run directory, None if there is none."""
    numbered = [(int(m.group(1)), f) for f in run.glob("model_*.pt") if (m := re.fullmatch(r"model_(\d+)\.pt", f.name))]
    return max(numbered)[1] if numbered else None


def _of_runs(name: str) -> Path | None:
    """Return the last or the best checkpoint of the last run that has one."""
    # Runs are named by their time, so the name's order is that of time.
    runs = sorted((r for r in LOG_ROOT.glob("*/*") if r.is_dir()), key=lambda r: r.name, reverse=True)
    found = (latest_checkpoint(r) if name == "latest" else r / "best.pt" for r in runs)
    return next((path for path in found if path is not None and path.is_file()), None)
