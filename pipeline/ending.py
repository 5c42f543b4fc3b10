"""How the program ends: every way that is no fault of its own has words and an exit code."""

from __future__ import annotations

import errno
import os
import signal
import sys
import tempfile
from collections.abc import Callable
from types import FrameType
from typing import Any

from cyclopts import CycloptsError

from pipeline.console import say, silence, tell, tell_notes
from pipeline.errors import INTERRUPTED_CODE, BeatfieldError
from pipeline.publish import NO_SPACE

OUT_OF_REACH = (
    *(errno.EACCES, errno.EPERM, errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EISDIR),
    *(errno.EIO, errno.ESTALE),
)
"""What is wrong with a name, its rights or the disk behind it, and not with the program."""
MORE_MEMORY = "use fewer --workers, raise `ulimit -v`, or take a larger machine"

LATER_S = 0.05
"""An interrupt that would be lost is tried again so much later."""


def hear_signals() -> None:
    """Let signals that end programs clear away what is half-done, as a person's Ctrl-C does.

    Those that are ignored stay so: who starts a program with `nohup` wants it to outlive the
    terminal.
    """
    for one in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(one) is not signal.SIG_IGN:
            signal.signal(one, interrupt)


def interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt; while the compiler calls back, where Python drops what is raised, a
    moment later."""
    while frame is not None:
        if frame.f_globals.get("__name__", "").startswith("llvmlite."):
            signal.signal(signal.SIGALRM, interrupt)
            signal.setitimer(signal.ITIMER_REAL, LATER_S)
            return
        frame = frame.f_back
    # Once: what is half-done is being cleared away then.
    signal.setitimer(signal.ITIMER_REAL, 0)
    raise KeyboardInterrupt


def guarded(command: Callable[[], Any]) -> int:
    """Do what a command does; return its exit code."""
    try:
        code = command()
        if sys.stdout is not None:
            sys.stdout.flush()
        if signal.setitimer(signal.ITIMER_REAL, 0)[0]:
            raise KeyboardInterrupt
    except BrokenPipeError:
        # Who reads has read enough (`beatfield verify ... | head`); nobody is left to tell. What
        # was to be done may not be: the exit code is that of programs which this signal ends.
        silence(sys.stdout, sys.stderr)
        return 128 + signal.SIGPIPE
    except OSError as error:
        return _of_the_system(error)
    except RuntimeError as error:
        # So the library for paths tells links that lead to one another.
        if "Symlink loop" not in str(error):
            raise
        say(f"error: links lead in a circle ({error}); mend them, or name another place")
        return 2
    except MemoryError as error:
        say(f"error: memory is not enough ({error}); {MORE_MEMORY}")
        return 1
    except CycloptsError:
        return 2
    except BeatfieldError as error:
        return tell(error)
    except KeyboardInterrupt as interrupt:
        say("interrupted; what is finished is kept")
        tell_notes(interrupt)
        return INTERRUPTED_CODE
    return code if isinstance(code, int) else 0


def _of_the_system(error: OSError) -> int:
    """Tell what the system refused; the exit code. What is a fault of the program is raised."""
    if error.filename is not None and error.errno in OUT_OF_REACH:
        say(
            f"error: {os.fsdecode(error.filename)}: cannot be reached ({error.strerror}); mend "
            "its name or its rights, or name another place"
        )
        return 2
    # Of a file there would be its name.
    if error.errno not in NO_SPACE or error.filename is not None:
        raise error
    silence(sys.stdout)
    places = f"{tempfile.gettempdir()} (TMPDIR)"
    if kept := os.environ.get("NUMBA_CACHE_DIR"):
        places += f", {kept} (NUMBA_CACHE_DIR)"
    say(
        "error: what is printed, a temporary file or compiled code cannot be written "
        f"({error.strerror}); free some space, also in {places}"
    )
    return 2
