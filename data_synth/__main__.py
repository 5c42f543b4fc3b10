"""``python -m data_synth OUT``: make synthetic patient studies."""

from __future__ import annotations

import argparse
import errno
import os
import signal
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Any

QUIET_S = 2.0
"""Work shorter than this shows no progress."""
REFRESH_S = 0.5
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
INTERRUPTED_CODE = 130
LATER_S = 0.05
"""An interrupt that would be lost is tried again so much later."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; the exit code: 0 done, 2 the command or the settings are wrong, 130 it was
    told to end, 141 nobody reads what it prints."""
    options = _parser().parse_args(arguments)
    # No picture needs a window.
    os.environ["MPLBACKEND"] = "agg"
    from data_synth.errors import SynthError

    try:
        _end_cleanly()
        _write_patients(options)
        if signal.setitimer(signal.ITIMER_REAL, 0)[0]:
            raise KeyboardInterrupt
    except SynthError as error:
        sys.stderr.write(f"error: {error}\n")
        return SynthError.exit_code
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; studies that are finished are kept\n")
        return INTERRUPTED_CODE
    except BrokenPipeError:
        # Who reads has read enough; the exit code is that of programs which this signal ends.
        _silence()
        return 128 + signal.SIGPIPE
    except OSError as error:
        # Of a file there would be its name.
        if error.errno not in (errno.ENOSPC, errno.EDQUOT) or error.filename is not None:
            raise
        _silence()
        sys.stderr.write(f"error: what is printed cannot be written ({error.strerror})\n")
        return SynthError.exit_code
    return 0


def _silence() -> None:
    """What is left to be printed goes nowhere, so that the end does not fail for it."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _end_cleanly() -> None:
    """Let signals that end programs interrupt the work once, so that what is half-done is cleared
    away; those that come meanwhile, as to all of a terminal's programs, are not heard."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        for one in heard:
            signal.signal(one, signal.SIG_IGN)
        # What is raised while the compiler calls back is lost; a moment later it is not.
        while frame is not None:
            if frame.f_globals.get("__name__", "").startswith("llvmlite."):
                signal.signal(signal.SIGALRM, interrupt)
                signal.setitimer(signal.ITIMER_REAL, LATER_S)
                return
            frame = frame.f_back
        signal.setitimer(signal.ITIMER_REAL, 0)
        raise KeyboardInterrupt

    # Python lets the main thread alone choose; those that are ignored, as `nohup` does, stay so.
    if threading.current_thread() is not threading.main_thread():
        return
    heard = [one for one in ENDING if signal.getsignal(one) is not signal.SIG_IGN]
    for one in heard:
        signal.signal(one, interrupt)


def _write_patients(options: argparse.Namespace) -> None:
    from data_synth.errors import SynthError
    from data_synth.settings import read_settings
    from data_synth.study import require_free, write_study

    if options.patients < 1:
        raise SynthError(f"--patients is {options.patients}; give 1 or more")
    first = read_settings(options.config, _changes(options))
    patients = [first]
    if options.patients > 1:
        if "patient_id" in first.model_fields_set:
            raise SynthError(
                f"patient_id is {first.patient_id}, the name of one, and --patients is "
                f"{options.patients}; leave one of them out"
            )
        patients = [
            first.model_copy(update={"seed": first.seed + k, "patient_id": f"patient-{k + 1:04d}"})
            for k in range(options.patients)
        ]
    for settings in patients:
        require_free(options.out / settings.patient_id, options.overwrite)
    for settings in patients:
        folder = options.out / settings.patient_id
        line = ProgressLine(settings.patient_id)
        try:
            write_study(folder, settings, line, options.overwrite, options.preview)
        finally:
            line.end()
        sys.stdout.write(f"{folder}\n")
        sys.stdout.flush()


def _changes(options: argparse.Namespace) -> dict[str, Any]:
    given = {
        "seed": options.seed,
        "pathology": options.pathology,
        "cine": options.cine,
        "cine_only": options.cine_only or None,
    }
    return {name: value for name, value in given.items() if value is not None}


class _Once(argparse.Action):
    """Refuses what is given twice, of which else the last would count."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option: Any = None) -> None:
        """Keep the value."""
        if getattr(namespace, self.dest) is not None:
            parser.error(f"argument {option}: given a second time; keep one of them")
        setattr(namespace, self.dest, values)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="beatfield synth", description="Make synthetic patient studies with known truth."
    )
    parser.add_argument(
        "out", type=Path, metavar="OUT", help="folder to write patient-0001/ ... in"
    )
    parser.add_argument("--seed", type=int, help="patient number k has SEED + k - 1 (default 1)")
    parser.add_argument("--patients", type=int, default=1, metavar="N", help="how many (default 1)")
    parser.add_argument(
        "--config", type=Path, action=_Once, metavar="YAML", help="settings of the phantom"
    )
    parser.add_argument(
        "--pathology",
        metavar="NAME",
        help="healthy (default), dilated_cardiomyopathy, hypertrophic_cardiomyopathy, rv_dilation, "
        "infarct or enlarged_atrium",
    )
    parser.add_argument(
        "--cine", choices=["dicom", "enhanced", "nifti"], help="format of the cine (default dicom)"
    )
    parser.add_argument(
        "--preview", action="store_true", help="write preview.html too: one page that shows it all"
    )
    parser.add_argument("--cine-only", action="store_true", help="leave out ECG and ultrasound")
    parser.add_argument("--overwrite", action="store_true", help="replace studies that exist")
    return parser


class ProgressLine:
    """One line on standard error that keeps up with work of more than two seconds."""

    def __init__(self, name: str) -> None:
        self.name, self.shown = name, False
        self.next = time.monotonic() + QUIET_S

    def __call__(self, done: int, total: int) -> None:
        """Tell how far the work has come."""
        if time.monotonic() > self.next:
            self.shown, self.next = True, time.monotonic() + REFRESH_S
            sys.stderr.write(f"\r{self.name}: {100 * done // total:3d} %")
            sys.stderr.flush()

    def end(self) -> None:
        """Leave the line behind."""
        if self.shown:
            sys.stderr.write("\n")


if __name__ == "__main__":
    sys.exit(main())
