"""Read tracked ultrasound sweeps: PLUS / SlicerIGT sequences in MetaImage files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Float, Float32, Integer, Mask
from pipeline.imaging.metaimage import SPACING, Fields, read_metaimage
from pipeline.imaging.stuck import without_stuck
from pipeline.imaging.sweep_poses import (
    TRACKER,
    always_identity,
    frame_of_poses,
    image_calibration,
    is_tracked,
    probe_pose,
    reference_pose,
    require_resting,
)

if TYPE_CHECKING:
    # For types only: a stage's product must not depend on how a study's folder is understood.
    from pipeline.study import UltrasoundFiles

_FRAME_KEY = re.compile(r"Seq_Frame(\d+)_(\w+)")
# A sweep goes over centimetres, and no tracker sees a probe at its own place: what stays within
# these is in metres.
_STILL_MM, _TOO_NEAR_MM = 1.0, 10.0
# No hand moves a probe as fast; time stamps jitter, so a short way is no leap however short the
# time; and by so many frames on either side it is known where the probe was.
_FASTEST_MM_S, _LEAP_MM, _STAYS = 2000.0, 20.0, 5
# Logarithm of width over height of a pixel that is told of: calibrations are off by some per cent,
# pixels of television are 7 % wider or 9 % narrower than high.
_UNSQUARE = 0.03
# A pixel's size by file and by calibration is the same, or 1 mm, within this.
_SAME_SIZE = 0.01


@dataclass(frozen=True, slots=True)
class Sweep:
    """Frames of one sweep whose pose is known."""

    name: str
    """Stem of the file."""

    images: Float32
    """``(n, rows, columns)`` grey values."""

    times_s: Float
    """``(n,)`` strictly rising, on the clock of the ECG recorded beside it."""

    tracker_from_image: Float
    """``(n, 4, 4)`` from pixel ``(i = column, j = row, 0)`` to tracker mm."""

    tracker_from_probe: Float
    """``(n, 4, 4)`` what of it the tracker saw: the pose of the marker on the probe."""

    numbers: Integer
    """``(n,)`` which frames of the file these are, counted from 0."""

    pose_frame: str = TRACKER
    """What the tracker's millimetres are counted from: itself, or the patient's reference."""

    tracker_from_reference: tuple[Float, ...] = ()
    """4x4 each: where the patient's reference was seen, in those frames that tell."""

    remarks: tuple[str, ...] = ()
    """What a person should know of how the file was read."""

    def only(self, kept: Mask, *remarks: str) -> Sweep:
        """The frames of a mask ``(n,)``, and more to be told of them."""
        return replace(
            self,
            images=self.images[kept],
            times_s=self.times_s[kept],
            tracker_from_image=self.tracker_from_image[kept],
            tracker_from_probe=self.tracker_from_probe[kept],
            numbers=self.numbers[kept],
            remarks=(*self.remarks, *remarks),
        )


def read_sweeps(files: UltrasoundFiles) -> list[Sweep]:
    """All sweeps of a study.

    Raises
    ------
    InputError
        When one cannot be read (`read_sweep`), when two show the same pictures, when their poses
        are in different frames, or when the patient's reference moves and nothing says whether
        poses are to follow it.
    """
    given = files.probe_from_image
    calibration = None if given is None else np.array(given, dtype=float)
    sweeps = [read_sweep(path, files.pose_frame, calibration) for path in files.sweeps]
    _require_own_pictures(files.sweeps, sweeps)
    folder, first = files.sweeps[0].parent, sweeps[0]
    other = next((one for one in sweeps if one.pose_frame != first.pose_frame), None)
    if other:
        raise InputError(
            f"{folder}: poses of {first.name} are in the frame {first.pose_frame}, those of "
            f"{other.name} in {other.pose_frame}; name one as us.pose_frame in study.yaml"
        )
    if files.pose_frame is None and first.pose_frame == TRACKER:
        seen = [pose for sweep in sweeps for pose in sweep.tracker_from_reference]
        probe_mm = np.concatenate([sweep.tracker_from_probe[:, :3, 3] for sweep in sweeps])
        require_resting(seen, probe_mm.mean(axis=0), str(folder))
    return sweeps


def _require_own_pictures(paths: Sequence[Path], sweeps: Sequence[Sweep]) -> None:
    """Refuse a sweep half of whose pictures, or more, are another's to the bit."""
    shown = [
        [hash(picture.tobytes()) for picture in sweep.images if np.ptp(picture) > 0]
        for sweep in sweeps
    ]
    for (one, mine), (other, theirs) in combinations(zip(paths, shown, strict=True), 2):
        few, many = sorted((mine, theirs), key=len)
        known = set(many)
        shared = sum(picture in known for picture in few)
        if few and shared >= len(few) / 2:
            raise InputError(
                f"{other}: {shared} of its pictures are those of {one} to the bit, which makes one "
                "recording count as two; name one of both under us.sweeps in study.yaml"
            )


def read_sweep(
    path: Path, pose_frame: str | None = None, probe_from_image: Float | None = None
) -> Sweep:
    """Read a ``.mha`` or ``.mhd`` sequence of 2D frames with a pose and a time for each.

    Frames whose image or transforms carry a status other than OK, or a pose of zeros, are left out
    and told; so are those that repeat a picture or a pose that is not theirs (`without_stuck`).
    Transforms may stand once for the whole file instead of in each frame.

    Parameters
    ----------
    pose_frame
        The frame of the poses, such as ``Tracker`` or ``Reference`` (the patient's marker); None:
        the tracker's where the file has ProbeToTracker, else that of the reference.
    probe_from_image
        4x4 from pixels to the probe's marker, mm, in place of the file's ImageToProbe.

    Raises
    ------
    InputError
        When the file is missing, truncated or no sequence of grey 2D frames, when a time or a
        transform is missing, not finite, not rigid or not a calibration in mm, when time stamps
        do not rise, or when no valid frame is left.
    """
    path = Path(path)
    images, header = read_metaimage(path)
    images, turned = _as_scanned(path, images, header)
    frames = _frame_fields(path, header, len(images))
    frame = frame_of_poses(frames, pose_frame)
    own = probe_from_image is None
    resting = always_identity(frames)
    valid = [k for k, fields in enumerate(frames) if is_tracked(fields, frame, own, resting)]
    if not valid:
        raise InputError(
            f"{path}: none of its {len(frames)} frames has status OK; the probe was out of the "
            "tracker's sight; record the sweep again"
        )
    times_s = np.array([_time_s(frames[k], f"{path}, frame {k}") for k in valid])
    _require_rising(path, times_s, valid)
    places = [(frames[k], f"{path}, frame {k}") for k in valid]
    tracker_from_probe = np.stack([probe_pose(one, frame, where) for one, where in places])
    calibrated = [image_calibration(one, probe_from_image, where) for one, where in places]
    spaced = _told_of_spacing(path, header, calibrated[0])
    seen = (reference_pose(one, resting) for one, _ in places)
    sweep = Sweep(
        path.stem,
        np.asarray(images[valid], dtype=np.float32),
        times_s,
        tracker_from_probe @ np.stack(calibrated),
        tracker_from_probe,
        np.array(valid),
        frame,
        tuple(pose for pose in seen if pose is not None),
        (
            *turned,
            *spaced,
            *_told_of_pixels(calibrated),
            *_left_out(len(frames) - len(valid), len(frames)),
        ),
    )
    return without_stuck(sweep)


def _told_of_spacing(path: Path, header: Fields, calibration: Float) -> list[str]:
    """A sentence where the file gives its pixels a size: by PLUS a calibration holds it already.

    Raises
    ------
    InputError
        When the calibration holds none, so that by 3D Slicer, which scales by the file's first,
        both go together.
    """
    told = np.array([float(word) for word in header[SPACING].split()])
    held = np.linalg.norm(calibration[:3, :2], axis=0)
    if np.allclose(told, 1, rtol=0, atol=_SAME_SIZE):
        return []
    size = " by ".join(f"{one:g}" for one in told)
    if np.allclose(held, 1, rtol=0, atol=_SAME_SIZE):
        raise InputError(
            f"{path}: {SPACING} makes pixels of {size} mm and ImageToProbe takes each for 1 mm: "
            "multiply the first two columns of ImageToProbe by them (or give the product as "
            "us.probe_from_image in study.yaml): it is to lead from pixels, as PLUS has it"
        )
    return [
        f"{SPACING} of {size} mm is not looked at: ImageToProbe leads from pixels, as PLUS has it"
    ]


def _told_of_pixels(calibrated: Sequence[Float]) -> list[str]:
    """A sentence where pixels are not square, as a scanner's are: no size of the heart tells."""
    wide_mm, high_mm = np.linalg.norm(np.array(calibrated)[0, :3, :2], axis=0)
    if abs(np.log(wide_mm / high_mm)) < _UNSQUARE:
        return []
    return [
        f"pixels are {wide_mm:.4g} mm wide and {high_mm:.4g} mm high by ImageToProbe: a scanner's "
        "are square, and a picture that was stretched since must have been calibrated so; look at "
        "the calibration"
    ]


def _left_out(missing: int, frames: int) -> list[str]:
    if not missing:
        return []
    return [f"{missing} of {frames} frames left out, which have no valid picture or pose"]


def remarks_on(sweeps: Sequence[Sweep]) -> list[str]:
    """What a person should know of the sweeps before a registration is used."""
    told = [f"{sweep.name}: {text}" for sweep in sweeps for text in sweep.remarks]
    frame = sweeps[0].pose_frame
    if frame != TRACKER:
        told.append(
            f"poses are those in the frame {frame}: mr_from_tracker starts from there, so give "
            "the tool's poses in it, too"
        )
    return told


def odd_transforms(sweeps: Sequence[Sweep]) -> str:
    """What the transforms of sweeps that do not fit their heart look like; empty if like nothing.

    Each may be right by itself, so nothing is refused for it.
    """
    probe_mm = np.concatenate([sweep.tracker_from_probe[:, :3, 3] for sweep in sweeps])
    spread_mm = float(np.linalg.norm(np.ptp(probe_mm, axis=0)))
    furthest_mm = float(np.linalg.norm(probe_mm, axis=1).max())
    found = []
    if spread_mm < _STILL_MM and furthest_mm < _TOO_NEAR_MM:
        found.append(
            f"ProbeTo{sweeps[0].pose_frame} looks as if it were in metres: over all sweeps the "
            f"probe moves by {spread_mm:.3g} mm, at {furthest_mm:.3g} mm from there or nearer; "
            "give mm"
        )
    if all(_is_uncalibrated(sweep) for sweep in sweeps):
        found.append(
            "ImageToProbe is the identity, pixels for millimetres: give the probe's calibration"
        )
    return "; ".join(found)


def leaps(sweeps: Sequence[Sweep]) -> list[str]:
    """A sentence for each sweep whose probe is suddenly elsewhere, and stays there.

    No hand is as fast; a single pose that is wrong comes back, and is none. Between them the
    tracker or its reference was moved, and frames of one side may not meet the heart at all.
    """
    told = []
    for sweep in sweeps:
        steps_s = np.diff(sweep.times_s)
        places_mm = sweep.tracker_from_probe[:, :3, 3]
        ways_mm = np.linalg.norm(np.diff(places_mm, axis=0), axis=1)
        # Poses of a slow tracker stand still for some frames, and then make up for it in one.
        anew_s = np.diff(sweep.times_s[1:][ways_mm > 0])
        since_s = np.maximum(steps_s, np.median(anew_s) if len(anew_s) else 0.0)
        fast = np.flatnonzero(ways_mm > np.maximum(_FASTEST_MM_S * since_s, _LEAP_MM))
        stays = [
            (_between_middles_mm(places_mm, int(k)), int(k))
            for k in fast
            if _STAYS <= k + 1 <= len(places_mm) - _STAYS
        ]
        way_mm, k = max(stays, default=(0.0, 0))
        if way_mm > _LEAP_MM:
            told.append(
                f"{sweep.name}: the probe leaps by {way_mm:.0f} mm within "
                f"{1000 * steps_s[k]:.0f} ms after {sweep.times_s[k]:.2f} s and stays there: was "
                "the tracker or its reference moved? Cut the sweep there"
            )
    return told


def _between_middles_mm(places_mm: Float, k: int) -> float:
    """How far the middle of the places up to number k is from that of those after it, where the
    step between them is most of that way; 0 elsewhere. A wrong place or two do not move a median.
    """
    before = np.median(places_mm[k + 1 - _STAYS : k + 1], axis=0)
    after = np.median(places_mm[k + 1 : k + 1 + _STAYS], axis=0)
    way_mm = float(np.linalg.norm(after - before))
    off_mm = float(np.linalg.norm(places_mm[k + 1] - places_mm[k] - (after - before)))
    return way_mm if off_mm < way_mm / 2 else 0.0


def _is_uncalibrated(sweep: Sweep) -> bool:
    return np.allclose(sweep.tracker_from_image, sweep.tracker_from_probe, rtol=0, atol=1e-9)


def _as_scanned(path: Path, images: Any, header: Fields) -> tuple[Any, tuple[str, ...]]:
    """Pixels whose columns count up to the transducer's marked side, and rows away from it: MF;
    and what is to be told of it.

    ImageToProbe belongs to pictures in this order, to which PLUS turns others when it reads them.
    """
    kind = header.get("UltrasoundImageType", "").upper()
    # Of colours only those are read that are all grey.
    if kind not in ("", "BRIGHTNESS", "RGB_COLOR", "UNKNOWN", "XX"):
        raise InputError(
            f"{path}: UltrasoundImageType is {kind}; it needs the brightness that a scanner shows "
            "(BRIGHTNESS): record, or convert it to, B-mode pictures"
        )
    orientation = header.get("UltrasoundImageOrientation", "MF").upper()
    if not re.fullmatch("[MU][FN][AD]?|XX|", orientation):
        raise InputError(
            f"{path}: UltrasoundImageOrientation is {orientation}; it needs MF, UF, MN or UN "
            "(columns count up to the marked or unmarked side, rows to the far or near end)"
        )
    if orientation in ("", "XX"):
        return images, ("UltrasoundImageOrientation is unknown, taken for MF",)
    if orientation[0] == "U":
        images = images[:, :, ::-1]
    return images[:, ::-1] if orientation[1] == "N" else images, ()


def _frame_fields(path: Path, header: Fields, slices: int) -> list[Fields]:
    """The fields of each frame; those of the whole file stand in where a frame has none."""
    shared = {key: value for key, value in header.items() if not _FRAME_KEY.fullmatch(key)}
    frames: dict[int, Fields] = {}
    for key, value in header.items():
        if match := _FRAME_KEY.fullmatch(key):
            frames.setdefault(int(match[1]), {})[match[2]] = value
    if sorted(frames) != list(range(slices)):
        raise InputError(
            f"{path}: holds {slices} images but describes {len(frames)} frames "
            f"({_span(frames)}); a sequence has Seq_Frame0000_... fields for every image, numbered "
            "from 0; export it again from PLUS or 3D Slicer"
        )
    return [shared | frames[k] for k in range(slices)]


def _span(frames: dict[int, Fields]) -> str:
    return f"numbers {min(frames)} to {max(frames)}" if frames else "no Seq_Frame fields"


def _time_s(fields: Fields, where: str) -> float:
    text = fields.get("Timestamp", "nothing")
    try:
        time_s = float(text)
    except ValueError:
        time_s = np.nan
    if not np.isfinite(time_s):
        raise InputError(f"{where}: Timestamp is {text}; it needs seconds on the ECG's clock")
    return time_s


def _require_rising(path: Path, times_s: Float, numbers: list[int]) -> None:
    back = np.flatnonzero(np.diff(times_s) <= 0)
    if len(back):
        k = int(back[0])
        raise InputError(
            f"{path}: time does not rise from frame {numbers[k]} ({times_s[k]} s) to frame "
            f"{numbers[k + 1]} ({times_s[k + 1]} s); {len(back)} such steps; time stamps must rise "
            "from frame to frame; sort the frames or mend the recorder's clock"
        )
