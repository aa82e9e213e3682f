"""Seconds of video that ``gaitgauge play`` makes in a second, and the processor time that it takes.

A busy machine lowers the first and hardly changes the second: real time needs fewer processor seconds for each second of video than
there are cores. Without a GPU pictures are drawn in several processes, each with a second's start that a long video does not notice.

    python benchmarks/video_speed.py --terrain stairs_fd --seconds 10
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from pathlib import Path

from gaitgauge.cli.picture import PLAIN, RICH, choose_renderer


def main() -> None:
    """Record one video for each quality that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--terrain", default="stairs_fd")
    parser.add_argument("--level", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=10.0, help="length of the video [s]")
    parser.add_argument("--quality", choices=("plain", "rich", "both", "chosen"), default="chosen")
    options = parser.parse_args()
    chosen = choose_renderer()
    names = {"chosen": ["plain" if chosen is PLAIN else "rich"], "both": ["plain", "rich"]}

    from gaitgauge.cli.drawing import processes_for
    from gaitgauge.cli.recording import FRAME_TIME, Recording, record
    from gaitgauge.cli.requests import PlayRequest
    from gaitgauge.cli.worlds import WorldMaker

    for name in names.get(options.quality, [options.quality]):
        quality = {"plain": PLAIN, "rich": RICH}[name]
        level = None if options.terrain == "flat" else options.level
        maker = WorldMaker(PlayRequest(policies=(), device="cpu"))
        session = maker.make("pretrained", options.terrain, level, 0.6, "pretrained")
        with tempfile.TemporaryDirectory() as folder:
            wanted = Recording(sessions=[session], seconds=options.seconds, video=Path(folder) / "a.mp4")
            began, own, others = time.perf_counter(), time.process_time(), _children()
            record(wanted, quality)
            wall = time.perf_counter() - began
            own, others = time.process_time() - own, _children() - others
        session.close()
        width, height = quality.size
        processes = processes_for(round(options.seconds / FRAME_TIME), quality)
        print(f"{name} ({width} x {height}), {options.terrain}, {options.seconds:g} s of video in {wall:.1f} s")
        print(f"  seconds of video per second            {options.seconds / wall:.2f}")
        print(f"  processor seconds per second of video  {(own + others) / options.seconds:.2f}, of these")
        what = "policy, physics, words" if processes else "policy, physics, words, drawing"
        print(f"    {what:36s} {own / options.seconds:.2f}")
        what = f"drawing ({processes} processes), encoding" if processes else "encoding"
        print(f"    {what:36s} {others / options.seconds:.2f}")


def _children() -> float:
    """Processor time of processes that have ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
