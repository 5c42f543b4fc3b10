"""What a person types as numbers, and what the command line says on standard error while it works,
and of what went wrong."""

from __future__ import annotations

import io
import os
import re
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, TextIO

from cyclopts import Parameter, Token

from pipeline.errors import BeatfieldError

if TYPE_CHECKING:
    # Only the command that runs a batch needs what that loads.
    from pipeline.batch_table import Outcome


_COMMANDS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
"""Characters that a terminal obeys and does not show."""


def _whole(_type: type[int], tokens: Sequence[Token]) -> int:
    """The parser's own way rounds 1.5 to 2."""
    text = tokens[0].value
    if not text.lstrip("+-").isdecimal():
        raise ValueError(f"needs a whole number, got {text}")
    return int(text)


Whole = Annotated[int, Parameter(converter=_whole)]


class Console:
    """Shows a run's course on standard error, a line for whatever takes over two seconds."""

    QUIET_S = 2.0

    def __init__(self) -> None:
        self._stage = ""
        self._last_s = 0.0

    def started(self, stage: str) -> None:
        """A stage begins."""
        self._stage = stage
        self._last_s = time.monotonic()
        _line(f"{stage:9s} ...")

    def progress(self, done: int, total: int) -> None:
        """Say how far the stage is, at most every two seconds."""
        now_s = time.monotonic()
        if now_s - self._last_s >= self.QUIET_S:
            self._last_s = now_s
            _line(f"{self._stage:9s} {done}/{total}")

    def ended(self, stage: str, outcome: str, seconds: float) -> None:
        """A stage ended."""
        took = f" in {seconds:.1f} s" if seconds else ""
        _line(f"{stage:9s} {outcome}{took}")


class BatchConsole:
    """Shows a batch's course on standard error, a line for each study that ended."""

    def __init__(self) -> None:
        self._began_s = time.monotonic()

    def ended(self, outcome: Outcome, done: int, total: int) -> None:
        """A study ended."""
        # As fast as until now: studies are alike, and those that were done before cost next to
        # nothing at the beginning.
        to_go_min = (time.monotonic() - self._began_s) / done * (total - done) / 60
        rest = f", about {to_go_min:.0f} min to go" if to_go_min >= 1 else ""
        took = f"{outcome.status} in {outcome.seconds:.1f} s"
        say(f"{done}/{total} {in_one_line(outcome.patient):24s} {took}{rest}")

    def interrupted(self, running: int) -> None:
        """No other study begins."""
        say(f"interrupted; waiting for {running} to end, Ctrl-C again ends them at once")


def _line(text: str) -> None:
    """Print on standard error, unless who called closed it."""
    if sys.stderr is not None:
        print(plain(text), file=sys.stderr, flush=True)


def say(text: str) -> None:
    """Print on standard error; work does not end because nobody can be told of it."""
    if sys.stderr is None:
        # Closed by who called: Python would print on standard output in its place.
        return
    try:
        print(plain(text), file=sys.stderr, flush=True)
    except RuntimeError:
        # A signal came while another line was printed.
        return
    except OSError:
        silence(sys.stderr)


def show(text: str) -> None:
    """Print a result on standard output."""
    # A terminal of few letters gets the numbers of those that it lacks.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    print(plain(text), flush=True)


def plain(text: str) -> str:
    """Text that may be shown: names and DICOM texts, which others write, command no terminal.

    >>> print(plain("a\x1b[2Jb"))
    a\\x1b[2Jb
    """
    return _COMMANDS.sub(lambda one: ascii(one[0])[1:-1], text)


def in_one_line(name: str) -> str:
    """A folder's name, which may hold the ends of lines."""
    return name.replace("\n", "\\n")


def warning_line(message: Warning | str, *_: object, **__: object) -> str:
    """A library's warning as one that may be shown: some tell what a file holds."""
    return plain(f"warning: {message}\n")


def silence(*streams: TextIO | None) -> None:
    """Let streams lead nowhere, so that Python can end without telling of them."""
    for stream in streams:
        if stream is None:
            continue
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def tell(error: BeatfieldError) -> int:
    """Say what went wrong and what to know beside it; return the exit code that this asks for."""
    say(f"error: {error}")
    tell_notes(error)
    return error.exit_code


def tell_notes(error: BaseException) -> None:
    """Say what is to be known beside an error."""
    for note in getattr(error, "__notes__", ()):
        say(f"note: {note}")
