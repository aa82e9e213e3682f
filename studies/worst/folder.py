"""The folder of a search: which search it holds, and the batches that are finished."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ...files.parsing import parse_json, read_text
from ...files.writing import json_text, lock_folder, make_folder, replacing, write_atomically
from .request import WorstError
from .search import Outcome


def check_folder(folder: Path, wanted: dict[str, Any], *, resume: bool) -> None:
    """Raise ``WorstError`` where a search cannot use a folder."""
    marker = folder / "search.json"
    if folder.exists() and not folder.is_dir():
        raise WorstError(f"{folder} is a file; give a folder with --out")
    if marker.is_file():
        present = parse_json(read_text(marker, "search", WorstError), str(marker), WorstError)
        if present != wanted:
            different = sorted(k for k in wanted if not isinstance(present, dict) or present.get(k) != wanted[k])
            raise WorstError(
                f"{folder} belongs to another search ({', '.join(different)} differ); give another folder with --out"
            )
        if not resume:
            raise WorstError(
                f"{folder} already holds this search; go on with --resume, or give another folder with --out"
            )
    elif folder.exists() and any(folder.iterdir()):
        raise WorstError(f"{folder} is not empty and holds no search; give another folder with --out")


class SearchLog:
    """Finished batches on disk, by what was played: a search that plays the same again reads them."""

    def __init__(self, folder: Path, identity: dict[str, Any], *, resume: bool) -> None:
        """Lock a folder for the search of this identity; raise ``WorstError`` where it cannot use the folder."""
        marker, wanted = folder / "search.json", json.loads(json.dumps(identity))
        self._folder = folder / "batches"
        check_folder(folder, wanted, resume=resume)
        make_folder(self._folder, WorstError)
        self._lock = lock_folder(folder, WorstError)
        write_atomically(marker, json_text(wanted), WorstError)

    def __enter__(self) -> SearchLog:
        return self

    def __exit__(self, *details: object) -> None:
        self._lock.release()

    def batch(self, key: object, play: Callable[[], list[Outcome]]) -> tuple[list[Outcome], float]:
        """Return the outcomes of a batch and the seconds that it took, from the disk where it was played before."""
        name = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:20]
        path = self._folder / f"{name}.json"
        if path.is_file():
            data = parse_json(read_text(path, "batch", WorstError), str(path), WorstError)
            return [Outcome(**row) for row in data["outcomes"]], float(data["seconds"])
        began = time.perf_counter()
        outcomes = play()
        seconds = time.perf_counter() - began
        data = {"seconds": round(seconds, 3), "outcomes": [asdict(outcome) for outcome in outcomes]}
        with replacing(path, WorstError, durable=False) as partial:
            partial.write_text(json_text(data))
        return outcomes, seconds

    def kept(self, name: str, value: int) -> int:
        """Return a number that was decided once, deciding it now where it was not."""
        path = self._folder / f"{name}.json"
        if path.is_file():
            return int(parse_json(read_text(path, name, WorstError), str(path), WorstError)[name])
        write_atomically(path, json_text({name: value}), WorstError)
        return value
