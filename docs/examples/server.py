"""A force server: samples of an ECG in, the heart's phase now, the force on a tool out.

    python docs/examples/server.py FIELD ECG X Y Z > forces.csv

plays a recording (WFDB, CSV or DICOM) as a monitor would send it and holds the tool's tip at one
point of the MR, in LPS millimetres. A real server does the same with its own samples, whose R times
it counts on the clock of its loop; with a tip that `field.mr_from_tracker` takes from the tracker's
frame to that of the MR; and turns the force back by the transposed rotation for its device.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

from pipeline.errors import InputError
from pipeline.field import ForceField
from pipeline.field.verify import verify_field
from pipeline.imaging.ecg import Ecg, read_ecg
from pipeline.registration.clock import PhaseClock
from pipeline.registration.rhythm import tell
from pipeline.registration.rpeaks import RPeakDetector

RATE_HZ = 1000
USUAL_RR_S = 0.8
"""Of a field that does not know the length of its heartbeat."""

Row = tuple[float, float, bool, float, float, float, float]


def serve(field: ForceField, ecg: Ecg, tip_mm: tuple[float, float, float]) -> Iterator[Row]:
    """Time (s, as recorded), phase, whether it is valid, share of the force rendered, force (N)."""
    fixture, law = next(iter(field.fixtures.items()))
    clock = PhaseClock(field.rr_s or USUAL_RR_S, f_max_n=law.f_max_n)
    detector = RPeakDetector(ecg.sampling_rate_hz, ecg.signal_mv.shape[1])
    # A first question may have to compile its kernel, which no loop should wait for.
    field.force_at(*tip_mm, 0.0, fixture)
    seen = 0
    for turn in range(int(len(ecg.signal_mv) / ecg.sampling_rate_hz * RATE_HZ)):
        passed_s = turn / RATE_HZ
        arrived = 1 + int(passed_s * ecg.sampling_rate_hz + 1e-6)
        for beat in detector.push(ecg.signal_mv[seen:arrived]):
            tell(clock, beat)
        seen = arrived
        outside = not field.contains([tip_mm])[0]
        tick = clock.at(passed_s, detector.usable, withheld=outside)
        force_n = field.force_at(*tip_mm, tick.phase, fixture)
        # Fading is all that a lost lead, an early beat, fibrillation or a tip that leaves the grid
        # asks of a server.
        x_n, y_n, z_n = (tick.fade * part for part in force_n)
        yield ecg.start_s + passed_s, tick.phase, tick.valid, tick.fade, x_n, y_n, z_n


def main(words: list[str]) -> int:
    """Print a row a millisecond as CSV."""
    try:
        path, record, *numbers = words
        x_mm, y_mm, z_mm = map(float, numbers)
    except ValueError:
        sys.stderr.write("use: server.py FIELD ECG X Y Z (LPS mm)\n")
        return 2
    try:
        # Opening reads no values: a damaged one would be a wrong force without a word.
        for text in verify_field(Path(path)).doubts:
            sys.stderr.write(f"note: {text}\n")
        # From memory: no question waits for a disk, or ends with a file that somebody cuts.
        field, tip_mm = ForceField.open(path, in_memory=True), (x_mm, y_mm, z_mm)
        if not field.contains([tip_mm])[0]:
            raise InputError(f"{path}: its grid does not hold the point; give one near the heart")
        rows = serve(field, read_ecg(Path(record), gaps=True), tip_mm)
        sys.stdout.write("time_s,phase,valid,fade,x_n,y_n,z_n\n")
        for time_s, phase, valid, fade, *force_n in rows:
            forces = ",".join(f"{part:.6f}" for part in force_n)
            sys.stdout.write(f"{time_s:.3f},{phase:.6f},{valid:d},{fade:.6f},{forces}\n")
    except InputError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
