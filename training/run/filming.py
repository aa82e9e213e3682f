"""Videos of the policy while it is being trained, made by ``gaitgauge play`` in a side process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from .side_process import CHILD_PROGRAM, Job, SideProcess

VIDEO_FOLDER = "videos"
"""Folder of a run directory that holds ``model_<iteration>_<terrain>.mp4``."""
SECONDS = 8.0
"""Length of a video [s]."""


class Filmer:
    """Takes checkpoints, gives videos back later."""

    def __init__(
        self,
        run: Path,
        *,
        terrains: Sequence[str],
        command: Sequence[float] | None = None,
        every: bool = True,
        last: bool = True,
    ) -> None:
        """Film into a run directory.

        Args:
            terrains: terrains of the gauge; one film for each.
            command: forward, lateral [m/s] and yaw [rad/s] speed; None for a tour that shows every direction.
            every: film when the run's interval says so.
        """
        self.every, self.last = every, last
        self._folder = run / VIDEO_FOLDER
        self._terrains, self._command = terrains, command
        self._submitted = -1
        self._side = SideProcess()
        self._given_up = False

    def submit(self, path: Path, iteration: int) -> None:
        """Ask for the videos of a checkpoint, once."""
        if self._given_up or iteration == self._submitted:
            return
        self._submitted = iteration
        told = ["--command", *map(str, self._command)] if self._command else []
        for terrain in self._terrains:
            output = self._folder / f"{path.stem}_{terrain}.txt"
            options = [
                "--terrain",
                terrain,
                "--seconds",
                f"{SECONDS:g}",
                "--out",
                str(output.with_suffix(".mp4")),
                *told,
            ]
            command = [*CHILD_PROGRAM, "play", str(path), *options]
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
                films.append((job.output.with_suffix(".mp4"), job.iteration))
                job.output.unlink(missing_ok=True)
                job.log.unlink(missing_ok=True)
            elif finished.failure == "skipped":
                sentence = (
                    f"No {job.output.with_suffix('.mp4').name}: filming is slower than training; raise --video-every."
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
