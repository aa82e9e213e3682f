"""``python -m gaitgauge.training.run.child MODULE …`` is ``python -m MODULE …`` in a process that does not outlive its parent.

A parent that is killed by SIGKILL can tell nobody. It gives its children a pipe as standard input (``side_process.parent_pipe``), in
which nothing is ever written: with the parent, however it ends, the system closes the other end. The child then gets SIGTERM: a training
writes a checkpoint, whatever else there is just ends.
"""

from __future__ import annotations

import os
import runpy
import signal
import sys
import threading


def main() -> None:
    """Watch the parent, and be the module that is named."""
    threading.Thread(target=_watch, daemon=True).start()
    runpy.run_module(sys.argv.pop(1), run_name="__main__", alter_sys=True)


def _watch() -> None:
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    main()
