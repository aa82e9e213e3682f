"""Videos of the policy while it is being trained, made by ``gaitgauge play`` in a side process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from .side_process import CHILD_PROGRAM, Job, SideProcess

VIDEO_FOLDER = "videos"
"""Folder of a run directory that holds ``model_<iteration>.mp4``."""
SECONDS = 8.0
"""Length of a video [s]."""


class Filmer:
    """Takes checkpoints, gives videos back later."""

    def __init__(self, run: Path, *, terrain: str) -> None:
        """Film into a run directory, on a terrain of the gauge."""
        self._folder = run / VIDEO_FOLDER
        self._terrain = terrain
        self._side = SideProcess()
        self._given_up = False

    def submit(self, path: Path, iteration: int) -> None:
        """Ask for a video of a checkpoint."""
        if self._given_up:
            return
        video = self._folder / f"{path.stem}.mp4"
        options = ["--terrain", self._terrain, "--seconds", f"{SECONDS:g}", "--out", str(video)]
        command, output = [*CHILD_PROGRAM, "play", str(path), *options], self._folder / f"{path.stem}.txt"
        self._side.submit(Job(command=command, checkpoint=path, iteration=iteration, output=output))

    def take(
        self, seconds: float = 0.0, stop: Callable[[], bool] = lambda: False
    ) -> tuple[list[tuple[Path, int]], str]:
        """Return videos that were finished since the last call, with their iterations; and a sentence for people, if there is one. Those
        that are pending are waited for, at most ``seconds`` [s], until ``stop`` says so.
        """
        films, sentence = [], ""
        for finished in self._side.drain(seconds, stop):
            job = finished.job
            if not finished.failure:
                films.append((self._folder / f"{job.checkpoint.stem}.mp4", job.iteration))
                job.output.unlink(missing_ok=True)
                job.log.unlink(missing_ok=True)
            elif finished.failure == "skipped":
                sentence = (
                    f"No video of iteration {job.iteration}: filming is slower than training; raise --video-every."
                )
            else:
                said = job.log.read_text(errors="replace").strip().splitlines() if job.log.is_file() else []
                reason = said[-1] if said else finished.failure
                sentence = f"No video of iteration {job.iteration}, and none from here on; training goes on: {reason}"
                self._given_up = True
                self._side.close()
        return films, sentence

    @property
    def pending(self) -> int:
        """Number of videos still to come."""
        return self._side.pending

    def close(self) -> None:
        """Give up pending videos."""
        self._side.close()
