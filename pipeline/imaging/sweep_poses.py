"""Poses of tracked frames: which transforms of a PLUS / SlicerIGT sequence lead to the tracker.

A transform ``AToB`` takes points of A to B. Most recordings hold ``ProbeToTracker``; where a marker
on the patient, ``Reference``, was tracked too, they hold ``ReferenceToTracker`` beside it, or
``ProbeToReference`` in its place.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet

import numpy as np

from pipeline.errors import InputError
from pipeline.geometry import Float, require_rigid

Fields = Mapping[str, str]

TRACKER, REFERENCE = "Tracker", "Reference"

# Pixels of a medical scanner, in mm: outside this the matrix is in other units, or no calibration.
_PIXEL_MM = (0.01, 4.0)
# A third column leaves the picture's plane by this share of a pixel or more, or it has none.
_LEAVES = 1e-3
# A marker that rests seems to move at the probe by some 0.4 mm (0.25 mm, and 0.1 degrees a hand's
# breadth or two away), root mean square.
_REST_MM = 0.8
_KEPT = 0.95


def frame_of_poses(frames: Sequence[Fields], asked: str | None) -> str:
    """The frame to which probes are tracked: what is asked for, else the tracker where any frame
    tells of it, else the patient's reference.

    Raises
    ------
    InputError
        When what is asked for moves with the probe.
    """
    if asked in ("Probe", "Image"):
        raise InputError(
            f"us.pose_frame of study.yaml: {asked} moves with the probe; name the tracker, or a "
            "marker on the patient"
        )
    if asked is not None:
        return asked
    told = any(_name("Probe", TRACKER) in fields for fields in frames)
    followed = any(_name("Probe", REFERENCE) in fields for fields in frames)
    return REFERENCE if followed and not told else TRACKER


def always_identity(frames: Sequence[Fields]) -> frozenset[str]:
    """Names of the transforms that are the identity, to the last bit, in every frame."""
    names = {name for name in frames[0] if name.endswith("Transform")}
    return frozenset(
        name for name in names if all(_is_identity(fields.get(name, "")) for fields in frames)
    )


def is_tracked(
    fields: Fields, frame: str, with_calibration: bool, resting: AbstractSet[str]
) -> bool:
    """Whether the picture and all transforms of its pose are valid, that of its pixels included.

    A matrix of zeros is no pose: some recorders write it, without a status, for a tool unseen; and
    others the identity, which is none but of what is ``resting`` there throughout
    (`always_identity`).
    """
    chain = [*([("Image", "Probe")] if with_calibration else []), *_chain(fields, frame)]
    names = ["ImageStatus", *(f"{_name(*link)}Status" for link in chain)]
    marked = any(fields.get(name, "OK").upper() != "OK" for name in names)
    blank = any(_is_blank(fields.get(_name(*link), "")) for link in chain)
    places = {_name(*link) for link in _chain(fields, frame)} - resting
    return not (marked or blank or any(_is_identity(fields.get(one, "")) for one in places))


def probe_pose(fields: Fields, frame: str, where: str) -> Float:
    """4x4 from the probe's marker to ``frame``, mm.

    Raises
    ------
    InputError
        When a transform that leads there is missing, not finite or not rigid.
    """
    pose = np.eye(4)
    for source, target in _chain(fields, frame):
        link = _matrix(fields, _name(source, target), where)
        require_rigid(link, f"{where}: {_name(source, target)}")
        # The frame's own pose leads out of it, and is gone the other way.
        pose = np.linalg.inv(link) @ pose if source == frame else link @ pose
    return pose


def image_calibration(fields: Fields, given: Float | None, where: str) -> Float:
    """4x4 from pixels to the probe's marker, mm: what is given, else the recording's.

    Raises
    ------
    InputError
        When there is none, or it does not spread pixels over a plane in millimetres.
    """
    if given is not None:
        require_calibration(given, "us.probe_from_image of study.yaml")
        return _invertible(given)
    name = _name("Image", "Probe")
    probe_from_image = _matrix(fields, name, where)
    require_calibration(probe_from_image, f"{where}: {name}")
    return _invertible(probe_from_image)


def _invertible(probe_from_image: Float) -> Float:
    """The same for pixels (i, j, 0); where the third column leaves their plane nowhere, such as one
    of zeros, across it by a pixel's size."""
    across, down, third = probe_from_image[:3, :3].T
    normal = np.cross(across, down)
    if abs(normal @ third) > _LEAVES * np.linalg.norm(normal) * np.linalg.norm(across):
        return probe_from_image
    whole = probe_from_image.copy()
    whole[:3, 2] = normal / np.sqrt(np.linalg.norm(normal))
    return whole


def reference_pose(fields: Fields, resting: AbstractSet[str]) -> Float | None:
    """4x4 from the patient's reference to the tracker; None where the recording does not tell, as
    by an identity of what is not ``resting`` there (`always_identity`)."""
    direct = _pose_if_valid(fields, (REFERENCE, TRACKER), resting)
    if direct is not None:
        return direct
    tracker_from_probe = _pose_if_valid(fields, ("Probe", TRACKER), resting)
    reference_from_probe = _pose_if_valid(fields, ("Probe", REFERENCE), resting)
    if tracker_from_probe is None or reference_from_probe is None:
        return None
    return np.asarray(tracker_from_probe @ np.linalg.inv(reference_from_probe))


def require_resting(tracker_from_reference: Sequence[Float], probe_mm: Float, where: str) -> None:
    """Refuse a patient's reference that moves, which poses in the tracker's frame leave out.

    Parameters
    ----------
    tracker_from_reference
        4x4 each.
    probe_mm
        ``(3,)`` where to judge its motion, in the tracker's frame.
    """
    if not tracker_from_reference:
        return
    known = np.stack(tracker_from_reference)
    motion = known @ np.linalg.inv(known[0])
    places_mm = motion[:, :3, :3] @ probe_mm + motion[:, :3, 3]
    off_mm = np.sort(np.linalg.norm(places_mm - np.median(places_mm, axis=0), axis=1))
    # A pose now and then that the tracker got wrong is no motion.
    away_mm = float(np.sqrt(np.mean(off_mm[: math.ceil(_KEPT * len(off_mm))] ** 2)))
    if away_mm > _REST_MM:
        raise InputError(
            f"{where}: the patient's {REFERENCE} moves against the tracker, by {away_mm:.1f} mm "
            f"at the probe (root mean square; {_REST_MM:g} mm would be noise); give us.pose_frame "
            f"in study.yaml: {REFERENCE} takes poses in its frame, in which the tool's must then "
            f"be given too, {TRACKER} takes them as if the patient had rested"
        )


def require_calibration(probe_from_image: Float, where: str) -> None:
    """Refuse a matrix that does not spread the pixels over a plane in millimetres."""
    across, down = probe_from_image[:3, 0], probe_from_image[:3, 1]
    pixel_mm = np.linalg.norm(across), np.linalg.norm(down)
    flat = np.linalg.norm(np.cross(across, down)) > 0.9 * pixel_mm[0] * pixel_mm[1]
    sized = _PIXEL_MM[0] <= min(pixel_mm) and max(pixel_mm) <= _PIXEL_MM[1]
    if not (flat and sized and np.allclose(probe_from_image[3], (0, 0, 0, 1))):
        raise InputError(
            f"{where}: is no calibration of pixels in mm: its pixels are {pixel_mm[0]:.3g} by "
            f"{pixel_mm[1]:.3g} mm; it needs two crossing axes of {_PIXEL_MM[0]} to "
            f"{_PIXEL_MM[1]} mm a pixel and a last row of 0 0 0 1, got\n{probe_from_image}"
        )


def _name(source: str, target: str) -> str:
    return f"{source}To{target}Transform"


def _chain(fields: Fields, frame: str) -> Sequence[tuple[str, str]]:
    """The transforms, source and target, that lead from the probe to a frame."""
    if frame == TRACKER or _name("Probe", frame) in fields:
        return [("Probe", frame)]
    if _name(frame, TRACKER) in fields:
        return [("Probe", TRACKER), (frame, TRACKER)]
    return [("Probe", frame)]


def _matrix(fields: Fields, name: str, where: str) -> Float:
    """The 4x4 matrix in field ``name``, row by row."""
    if name not in fields:
        others = sorted(key for key in fields if key.endswith("Transform"))
        raise InputError(
            f"{where}: has no {name}; its transforms are {', '.join(others) or 'none'}; a sweep "
            "needs ProbeToTracker or ProbeToReference (the marker's pose), and ImageToProbe (the "
            "calibration; or give us.probe_from_image in study.yaml)"
        )
    matrix = _numbers(fields[name])
    if matrix is None:
        raise InputError(f"{where}: {name} needs 16 finite numbers, got {fields[name]!r}")
    return matrix


def _pose_if_valid(
    fields: Fields, link: tuple[str, str], resting: AbstractSet[str]
) -> Float | None:
    name = _name(*link)
    matrix = _numbers(fields.get(name, ""))
    valid = fields.get(f"{name}Status", "OK").upper() == "OK"
    seen = name in resting or not _is_identity(fields.get(name, ""))
    sound = matrix is not None and np.linalg.det(matrix) > 0.5
    return matrix if valid and seen and sound else None


def _numbers(text: str) -> Float | None:
    """The matrix that a text of 16 finite numbers holds, row by row."""
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        return None
    return values.reshape(4, 4) if values.shape == (16,) and np.isfinite(values).all() else None


def _is_blank(text: str) -> bool:
    matrix = _numbers(text)
    return matrix is not None and not matrix[:3].any()


def _is_identity(text: str) -> bool:
    matrix = _numbers(text)
    return matrix is not None and np.array_equal(matrix, np.eye(4))
