"""Seconds of video that ``gaitgauge play`` makes in a second, and where the time goes.

Prints the wall-clock rate, which a busy machine lowers, and the processor time of each part, which it hardly does: what a picture
costs is divided among the cores by the driver, and the encoder has a process of its own.

    python benchmarks/video_speed.py --terrain stairs_fd --seconds 6
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gaitgauge.cli.picture import PLAIN, RICH, choose_renderer


def main() -> None:
    """Record one video for each quality that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--terrain", default="stairs_fd")
    parser.add_argument("--level", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=6.0, help="length of the video [s]")
    parser.add_argument("--quality", choices=("plain", "rich", "both", "chosen"), default="chosen")
    options = parser.parse_args()
    chosen = choose_renderer()
    qualities = {"plain": PLAIN, "rich": RICH}
    names = {
        "chosen": ["plain" if chosen is PLAIN else "rich"],
        "both": ["plain", "rich"],
    }.get(options.quality, [options.quality])

    from gaitgauge.cli.recording import Recording, record
    from gaitgauge.cli.worlds import WorldMaker

    for name in names:
        level = None if options.terrain == "flat" else options.level
        maker = WorldMaker(backend="mujoco", device="cpu", seed=0, trust=False)
        session = maker.make("pretrained", options.terrain, level, 0.6, "pretrained")
        spent = _timed()
        with tempfile.TemporaryDirectory() as folder:
            began, used = time.perf_counter(), time.process_time()
            record(
                Recording(sessions=[session], seconds=options.seconds, video=Path(folder) / "a.mp4"), qualities[name]
            )
            wall, processor = time.perf_counter() - began, time.process_time() - used
        session.close()
        width, height = qualities[name].size
        print(f"{name} ({width} x {height}), {options.terrain}, {options.seconds:g} s of video in {wall:.1f} s")
        print(f"  seconds of video per second          {options.seconds / wall:.2f}")
        print(f"  processor seconds per second of video {processor / options.seconds:.2f} (the encoder's apart)")
        for part, seconds in spent.items():
            print(f"    {part:35s} {seconds / options.seconds:.3f}")


def _timed() -> dict[str, float]:
    """Measure the parts of a recording from here on: processor seconds by part, filled while it runs."""
    from gaitgauge.cli import recording
    from gaitgauge.cli.picture import Picture
    from gaitgauge.cli.play_session import PlaySession

    spent = {"policy and physics": 0.0, "drawing": 0.0, "words in the picture": 0.0}

    def watch(owner: Any, name: str, part: str) -> None:
        original: Callable[..., Any] = getattr(owner, name)
        original = getattr(original, "__wrapped__", original)

        def timed(*arguments: Any, **more: Any) -> Any:
            began = time.process_time()
            result = original(*arguments, **more)
            spent[part] += time.process_time() - began
            return result

        timed.__wrapped__ = original  # type: ignore[attr-defined]
        setattr(owner, name, timed)

    watch(PlaySession, "step", "policy and physics")
    watch(Picture, "draw", "drawing")
    watch(recording, "annotate", "words in the picture")
    return spent


if __name__ == "__main__":
    main()
