"""One study of a batch: ``beatfield``, which ends when the batch does, however that ends."""

from __future__ import annotations

import os
import signal
import sys
import threading

from pipeline.cli import main


def run() -> int:
    """Run the command line's words as a part of a batch; return its exit code."""
    # A terminal sends these to all of its programs. The batch tells its studies itself, once:
    # a second signal would end what the first one began to clear away.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    threading.Thread(target=_end_with_the_batch, daemon=True).start()
    return main()


def _end_with_the_batch() -> None:
    """Wait for the end of a pipe that only the batch holds, and in which it writes nothing."""
    os.read(0, 1)
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(run())
