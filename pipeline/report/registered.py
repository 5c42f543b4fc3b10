"""The ultrasound's part of the report: frames with the registered surfaces, and what to mind."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from pipeline.geometry import MovingSurface
from pipeline.imaging.ultrasound import Sweep, read_sweeps
from pipeline.job import Job
from pipeline.products import FrameRow, read_frames, read_table
from pipeline.registration.correction import put_right
from pipeline.registration.reading import Reader
from pipeline.registration.uncertainty import expected_tre_mm
from pipeline.report import certainty, pictures
from pipeline.report.page import Section, picture
from pipeline.report.style import as_png, as_webp
from pipeline.summary import clock_put_right

ULTRASOUND_FRAMES_SHOWN = 4
NOT_USED_TOLD = (
    "The last frame is one of those that do not bear the registration out: it shows something "
    "else, or the heart beside its place. "
)
BLOOD_TOLD = (
    "The second row shows where blood of the cavities was found in the same frames, light where it "
    "is certain: this is what the surfaces were laid over, and it should fill the lines of the "
    "cavities. "
)


def registration_notes(job: Job) -> list[str]:
    """What to mind of the ultrasound, before anything is looked at."""
    if job.study.us is None:
        return []
    if not job.product("register"):
        return [f"The tracked ultrasound could not be registered: {job.skipped['register']}."]
    figures = job.figures("register")
    notes = [f"Clocks: {text}." for text in clock_put_right(figures)]
    if figures["verdict"] != "good":
        notes.append(f"Registration {figures['verdict']}: {figures['reason']}.")
    return notes


def registration(job: Job, surfaces: dict[str, MovingSurface]) -> list[Section]:
    """The section, or none where no ultrasound was registered."""
    folder = job.product("register")
    if folder is None or job.study.us is None:
        return []
    found = read_table(folder / "mr_from_tracker.json")
    covariance, centre_mm = np.array(found["covariance"]), np.array(found["centre_mm"])
    chosen = frames_shown(read_frames(folder / "frames.csv"))
    by_network = job.figures("register")["reading"] == "network"
    figure = _cuts(chosen, read_sweeps(job.study.us), found, surfaces, by_network)
    heart_in_mm = certainty.expected_error(
        surfaces, lambda points_mm: expected_tre_mm(covariance, centre_mm, points_mm)
    )
    return [
        Section(
            "Registration",
            "The MR's surfaces cut by the plane of tracked ultrasound frames, each at its own "
            "phase of the heartbeat. Where the lines follow the walls, the registration holds. "
            + ("" if all(row.valid for row in chosen) else NOT_USED_TOLD)
            + (BLOOD_TOLD if by_network else "")
            + "At last, how far off it is to be expected at each place of the heart.",
            [
                picture("Ultrasound with the registered surfaces", as_png(figure), "png"),
                picture(
                    "Expected registration error over the heart, root mean square",
                    as_webp(heart_in_mm, 110),
                    "webp",
                ),
            ],
        )
    ]


def _cuts(
    chosen: Sequence[FrameRow],
    sweeps: Sequence[Sweep],
    found: Mapping[str, Any],
    surfaces: Mapping[str, MovingSurface],
    by_network: bool,
) -> Figure:
    """Frames with the surfaces where they cut them, and with the blood that the network found."""
    named = {sweep.name: sweep for sweep in sweeps}
    places = [named[row.sweep].numbers.tolist().index(row.frame) for row in chosen]
    # Probes differ, and so may the sizes of their pictures.
    images = [named[row.sweep].images[at] for row, at in zip(chosen, places, strict=True)]
    tracker_from_image = {
        name: put_right(sweep.tracker_from_image, name, found["calibration"])
        for name, sweep in named.items()
    }
    mr_from_tracker = np.array(found["mr_from_tracker"])
    image_from_mr = np.stack(
        [
            np.linalg.inv(mr_from_tracker @ tracker_from_image[row.sweep][at])
            for row, at in zip(chosen, places, strict=True)
        ]
    )
    titles = [
        ("" if row.valid else "NOT USED:\n") + f"{row.sweep}, frame {row.frame}" for row in chosen
    ]
    phases = np.array([row.phase for row in chosen])
    blood = []
    if by_network:
        readers = {name: Reader.of(named[name]) for name in {row.sweep for row in chosen}}
        for row, image in zip(chosen, images, strict=True):
            reader = readers[row.sweep]
            blood.append(pictures.BloodFound(reader.read(image[None])[0], reader.step))
    return pictures.cuts_on_ultrasound(images, titles, image_from_mr, phases, surfaces, blood)


def frames_shown(rows: list[FrameRow]) -> list[FrameRow]:
    """Frames that bear the registration out, evenly, and the middle one of those that do not."""
    used = [row for row in rows if row.valid]
    # Of a residual of 1 nothing could be compared: the probe was in air, say.
    against = [row for row in rows if not row.valid and row.residual < 1]
    count = min(ULTRASOUND_FRAMES_SHOWN - bool(against), len(used))
    chosen = [used[k] for k in np.linspace(0, len(used) - 1, count).astype(int)]
    return chosen + against[len(against) // 2 :][:1]
