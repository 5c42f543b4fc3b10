"""Write a cine as a scanner exports it: classic or Enhanced MR images, stack and views."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from data_synth.dicom_classic import write_classic
from data_synth.dicom_enhanced import write_enhanced
from data_synth.dicom_header import ImageSeries
from data_synth.errors import SynthError
from data_synth.mr import SyntheticCine
from data_synth.protocol import BREATH_HOLD_S, MrSettings

LONGEST_PATIENT_ID = 56
"""64 characters are all that PatientName has room for, "Phantom^" among them."""


def write_dicom(
    folder: Path,
    patient_id: str,
    key: str,
    cine: SyntheticCine,
    settings: MrSettings,
    views: Mapping[str, SyntheticCine] | None = None,
    enhanced: bool = False,
) -> None:
    """Write the stack, and every view as a further series, below ``folder/<series number>/``.

    Classic: a series a slice of a stack, one series for a volume and for each view; a file a
    frame, ``IM_<instance>.dcm``. Enhanced: a series and an object for the whole stack, for a
    volume and for each view.

    Parameters
    ----------
    folder
        Made if missing.
    patient_id
        Goes into PatientID and PatientName.
    key
        Text from which all UIDs are derived.
    cine
        Images, geometry and times of the short-axis stack or the volume.
    settings
        Protocol values that the headers repeat.
    views
        Long-axis views by name (``"two_chamber"``), one slice each.
    enhanced
        Multi-frame objects instead of a file a frame.

    Raises
    ------
    SynthError
        When the patient's name does not fit in a DICOM header.
    """
    require_room(patient_id)
    write = write_enhanced if enhanced else write_classic
    for series in _plan(cine, settings, views or {}, enhanced):
        write(folder / f"{series.number:03d}", patient_id, key, series, settings)


def require_room(patient_id: str) -> None:
    """Raise SynthError when the patient's name does not fit in a DICOM header."""
    if len(patient_id) > LONGEST_PATIENT_ID:
        raise SynthError(
            f"patient_id: {patient_id!r} has {len(patient_id)} characters; DICOM has room for "
            f"{LONGEST_PATIENT_ID}, choose a shorter one"
        )


def _plan(
    cine: SyntheticCine,
    settings: MrSettings,
    views: Mapping[str, SyntheticCine],
    enhanced: bool,
) -> Iterator[ImageSeries]:
    """The series of the examination in the order of their breath-holds."""
    slices = tuple(range(cine.intensity.shape[1]))
    if settings.acquisition == "volume":
        first = [ImageSeries(1, "cine volume", cine, slices, 0.0, volume=True)]
    elif enhanced:
        first = [ImageSeries(1, "cine short axis", cine, slices, 0.0)]
    else:
        first = [
            ImageSeries(z + 1, f"cine short axis, slice {z + 1}", cine, (z,), z * BREATH_HOLD_S)
            for z in slices
        ]
    yield from first
    number, start_s = first[-1].number, first[-1].start_s + first[-1].duration_s
    for k, (name, view) in enumerate(views.items()):
        title = f"cine long axis, {name.replace('_', ' ')}"
        yield ImageSeries(number + 1 + k, title, view, (0,), start_s + k * BREATH_HOLD_S)
