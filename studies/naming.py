"""Name policies for people, and the folders that hold their results: short, and never two alike."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..files.parsing import bare_name, one_line
from ..gauge.store import StoreError, check_folder
from ..policy.base import PolicyError
from ..policy.finding import OF_RUNS, find_policy

_LONGEST = 80
"""Characters of a name."""
_LONGEST_FOLDER = 120
"""Characters of the names of several policies in one folder's name."""
_NOTHING = re.compile(r"policy|model|results|kept|exported|export|checkpoints|runs|\.*", re.IGNORECASE)
"""Parts of a path that do not tell policies apart."""
_LITTLE = re.compile(r"best|last|(model|seed)?[-_]?\d+", re.IGNORECASE)
"""Parts that tell something only with the one before them."""


def distinct_names(paths: Sequence[str]) -> list[str]:
    """Names for people: ``walk`` of ``walk.gauge.pt``, ``HIM seed-1`` of ``sweep/runs/HIM/seed-1/kept/policy.gauge.pt``.

    Each is the shortest end of its path that tells something, without the parts that do not; where two are alike, the shortest end
    that tells them apart, whole file names where even that does not, and numbers at last.

    Args:
        paths: files or names, of this machine or another.
    """
    chains = [_candidates(path) for path in paths]
    ends = dict.fromkeys(chains, 0)
    while True:
        names = {chain: chain[min(end, len(chain) - 1)] for chain, end in ends.items()}
        longer = [chain for chain in _alike(names) if ends[chain] < len(chain) - 1]
        if not longer:
            break
        for chain in longer:
            ends[chain] += 1
    found = dict(enumerate(names[chain] for chain in chains))
    numbered = _alike(found)
    return [f"{name} ({at + 1})" if at in numbered else name for at, name in found.items()]


def _alike(names: Mapping[Any, str]) -> list[Any]:
    """Which have a name that another one has, as folders have them, on any disk."""
    folders = {key: folder_name(name).casefold() for key, name in names.items()}
    counts = Counter(folders.values())
    return [key for key, folder in folders.items() if counts[folder] > 1]


def _candidates(path: str) -> tuple[str, ...]:
    """Names that a path can have, the shortest that tells something first."""
    parts = [part for part in re.split(r"[/\\]", path) if part] or [path or "policy"]
    bare = [bare_name(part) for part in parts]
    telling = [part for part in bare if not _NOTHING.fullmatch(part)] or [bare[-1] or parts[-1]]
    return (*_ends(telling), *_ends(parts))


def _ends(parts: Sequence[str]) -> list[str]:
    """Ends of a path, from the last part that tells something on its own."""
    strong = [i for i, part in enumerate(parts) if not (_NOTHING.fullmatch(bare_name(part)) or _LITTLE.fullmatch(part))]
    first = strong[-1] if strong else len(parts) - 1
    return [one_line(" ".join(parts[i:]), _LONGEST) for i in range(first, -1, -1)]


def folder_name(name: str) -> str:
    """A name as a folder has it."""
    return re.sub(r"[\s/\\]+", "-", name)


def joined_names(policies: Sequence[str]) -> str:
    """The names of some policies as one folder's name."""
    names = [folder_name(name) for name in distinct_names(found_policies(dict.fromkeys(policies)))]
    whole = "-".join(names)
    return whole if len(whole) <= _LONGEST_FOLDER else f"{'-'.join(names[:3])[:_LONGEST_FOLDER]}-of-{len(names)}"


def run_folders(
    policies: Sequence[str], root: Path, *, suite: str, pipeline: str, parameters: str | None = None
) -> list[Path]:
    """Return the folder of the evaluation of each of some policies, before ``free_folder``."""
    sets = [] if parameters is None else [bare_name(Path(parameters).name)]
    end = "-".join([bare_name(suite), *sets, pipeline])
    return [root / f"{folder_name(name)}-{end}" for name in distinct_names(found_policies(policies))]


def found_policies(policies: Iterable[str]) -> list[str]:
    """Return policies with the checkpoints that ``latest`` and ``best`` stand for now: the next training changes them."""
    found = []
    for name in policies:
        with suppress(PolicyError):  # what is wrong with it is said when it is loaded
            name = str(find_policy(name)) if name in OF_RUNS else name
        found.append(name)
    return found


def free_folder(folder: Path, is_free: Callable[[Path], bool]) -> Path:
    """Return a folder, or the first of ``<folder>-2``, ``<folder>-3`` …, that is free."""
    numbered = (folder.with_name(f"{folder.name}-{number}") for number in itertools.count(2))
    return next(path for path in itertools.chain([folder], numbered) if is_free(path))


def free_run_folder(folder: Path, *runs: tuple[str, Mapping[str, Any]]) -> Path:
    """Return a folder, or the first of ``<folder>-2`` …, in which no other runs are.

    Args:
        runs: folder of each run in it, ``""`` for itself, and the request that decides about its results.
    """

    def is_free(candidate: Path) -> bool:
        try:
            for name, request in runs:
                check_folder(candidate / name, request, resume=True)
        except StoreError:
            return False
        return True

    return free_folder(folder, is_free)
