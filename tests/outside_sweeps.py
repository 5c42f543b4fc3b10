"""Tracked sweeps over the hearts of `tests.outside_heart`, with the pictures of
`tests.outside_ultrasound`: nothing of them comes from the project's phantom.

The operator's windows are given in the heart's own frame (`tests.outside_anatomy`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_erosion, gaussian_filter1d
from scipy.spatial.transform import Rotation

from pipeline.registration.frames import DisplacedSweep
from tests.outside_anatomy import (
    BASE_MM,
    Kind,
    bent,
    heart_axes,
    heart_stuff,
    left_ventricle,
)
from tests.outside_chest import chest_stuff
from tests.outside_people import Body, draw_body, made_ill
from tests.outside_ultrasound import (
    FANS,
    OF_HEART,
    Console,
    Float,
    StuffAt,
    picture,
)

EXAMINATIONS = {
    "combined": (("surface", 0), ("transoesophageal", 0)),
    "intracardiac": (("intracardiac", 0), ("intracardiac", 1)),
    "epicardial": (("epicardial", 0), ("epicardial", 1)),
}
"""Kind of probe and number of its window, sweep by sweep."""

STANDOFF_MM = {"surface": 14.0, "transoesophageal": 5.0, "epicardial": 8.0}
RATE_HZ, RR_S = 25.0, 0.87
CALIBRATION_MM, CALIBRATION_DEG = 0.17, 0.12
"""Deviations along and about each axis of what is the same error for all frames of a sweep."""
TRACKER_MM = 0.1
BREATH_MM = 0.5
"""Deviation between sweeps, most of it along head and feet."""
HAND_MM, HAND_DEG = 1.0, 1.2


@dataclass(frozen=True, slots=True)
class Recording:
    """Sweeps, and the truth about them."""

    sweeps: list[DisplacedSweep]
    phases: list[Float]
    blood: list[np.ndarray]
    """Of each sweep ``(n, h, w)`` True where cavities lie in the pictures' planes."""
    mr_from_tracker: Float
    targets_mm: Float
    """``(n, 3)`` points of the heart's outside at end-diastole, LPS."""


def person(seed: int, illness: str = "") -> Body:
    """The one that `tests.outside_heart.render` scans for this seed and illness."""
    body = draw_body(np.random.default_rng([seed, 77]))
    return made_ill(np.random.default_rng([seed, 78]), body, illness) if illness else body


def stuff_of(body: Body, phase: float, moved_mm: Float | None = None) -> StuffAt:
    """What lies at LPS points of the person at this phase, moved by breathing."""
    axes, moved = heart_axes(body), np.zeros(3) if moved_mm is None else moved_mm
    # Beyond what is drawn of healthy hearts, a wide right ventricle's reach is added.
    wide_mm = 85 + max(0.0, 1.5 * (body.rv_reach - 50))

    def at(points_mm: Float) -> Kind:
        crooked = bent(body, (points_mm - moved).astype(np.float32))
        stuff = np.array(chest_stuff(body, crooked))
        own = (crooked - BASE_MM.astype(np.float32)) @ axes.T.astype(np.float32)
        near = np.flatnonzero((np.abs(own[:, 0] - 18) < wide_mm) & (np.abs(own[:, 1]) < 80))
        heart = heart_stuff(body, own[near], phase)
        stuff[near[heart > 0]] = heart[heart > 0]
        return stuff

    return at


def record(seed: int, body: Body, examination: str, frames: int = 40) -> Recording:
    """One examination with a console of its own; ``frames`` of each sweep."""
    rng = np.random.default_rng([seed, len(examination), 3])
    mr_from_tracker = np.eye(4)
    mr_from_tracker[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    mr_from_tracker[:3, 3] = rng.normal(0, 150, 3)
    consoles: dict[str, Console] = {}
    sweeps, phases, blood = [], [], []
    for number, (kind, window) in enumerate(EXAMINATIONS[examination]):
        fan = FANS[kind]
        console = consoles.setdefault(kind, Console.drawn(rng, fan))
        poses = _poses(rng, _placed(rng, body, kind, window), kind, frames)
        moved_mm = np.array([0.1, 0.35, 0.93]) * rng.normal(0, BREATH_MM)
        calibration = _small(rng, CALIBRATION_MM, CALIBRATION_DEG)
        times = (np.arange(frames) / RATE_HZ / RR_S + rng.random()) % 1.0
        shown = [
            picture(rng, console, fan, stuff_of(body, float(phase), moved_mm), pose)
            for phase, pose in zip(times, poses, strict=True)
        ]
        tracked = [_small(rng, TRACKER_MM, 0.0) @ pose @ calibration for pose in poses]
        tracker_from_image = np.linalg.inv(mr_from_tracker) @ tracked @ fan.transducer_from_image
        images = np.stack([one.grey for one in shown]).astype(np.float32)
        sweeps.append(DisplacedSweep(f"sweep_{number:03d}", images, tracker_from_image))
        phases.append(times)
        blood.append(np.stack([one.blood for one in shown]))
    return Recording(sweeps, phases, blood, mr_from_tracker, _outside_mm(body))


def _placed(rng: np.random.Generator, body: Body, kind: str, window: int) -> Float:
    """4x4 LPS from transducer at the middle of a sweep."""
    axes, now = heart_axes(body), left_ventricle(body, 0.0)
    ahead, behind, up = axes @ (0.3, -1, 0), axes @ (0.0, 1, 0), axes @ (0.0, 0, 1)
    across, base = rng.standard_normal(3), np.array([0.0, 0, 1])
    if kind == "intracardiac":
        rest, long = now.radius + now.wall, body.lv_length
        tips = (rest + 0.3 * body.rv_reach, -8, 20), (rest + 0.45 * body.rv_reach, 0, -0.35 * long)
        target = np.array([(0, 0, -12), (0, 0, -0.4 * long)][window]) + rng.normal(0, 4, 3)
        tip = np.array(tips[window]) + rng.normal(0, 2, 3)
        across = (up, base)[window]
    else:
        ways = {
            "surface": [(0.1, 0.15, -1.0), ahead],
            "transoesophageal": [behind + 0.4 * base, behind + 0.9 * base],
            "epicardial": [ahead, (0.1, 0.1, -1.0)],
        }
        deep = {"surface": -12, "transoesophageal": -8, "epicardial": -30}[kind]
        target = np.array([8.0, 0, deep]) + rng.normal(0, 4, 3)
        way = _unit(_unit(np.array(ways[kind][window])) + rng.normal(0, 0.08, 3))
        along = np.arange(0.0, 180.0)
        stuff = stuff_of(body, 0.0)(BASE_MM + (target + along[:, None] * way) @ axes)
        skin = along[np.isin(stuff, OF_HEART)].max() + STANDOFF_MM[kind]
        tip = target + skin * way
    y = _unit(target - tip)
    x = _unit(across - (across @ y) * y)
    pose = np.eye(4)
    pose[:3, :3] = axes.T @ np.stack([x, y, np.cross(x, y)], axis=1)
    pose[:3, 3] = BASE_MM + tip @ axes
    return pose


def _poses(rng: np.random.Generator, middle: Float, kind: str, frames: int) -> Float:
    """``(n, 4, 4)``: turned about the beam, or the shaft that lies in the fan, by a hand."""
    wander = gaussian_filter1d(rng.standard_normal((frames, 6)), frames / 7, axis=0)
    wander = (wander - wander.mean(axis=0)) / np.maximum(wander.std(axis=0), 1e-3)
    axis, turn_deg = {
        "surface": ((0, 1, 0), 130), "transoesophageal": ((0, 1, 0), 130),
        "epicardial": ((1, 0, 0), 55), "intracardiac": ((1, 0, 0), 80),
    }[kind]  # fmt: skip
    poses = []
    for share, sway in zip(np.linspace(-0.5, 0.5, frames), wander, strict=True):
        move = np.eye(4)
        turn = Rotation.from_rotvec(np.radians(share * turn_deg) * np.array(axis))
        move[:3, :3] = (turn * Rotation.from_rotvec(np.radians(HAND_DEG) * sway[:3])).as_matrix()
        move[:3, 3] = HAND_MM * sway[3:]
        poses.append(middle @ move)
    return np.stack(poses)


def _small(rng: np.random.Generator, mm: float, deg: float) -> Float:
    """A rigid motion of these deviations along and about each axis."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(np.radians(deg) * rng.standard_normal(3)).as_matrix()
    motion[:3, 3] = mm * rng.standard_normal(3)
    return motion


def _outside_mm(body: Body) -> Float:
    """Points of the heart's outside, 5 mm apart."""
    lines = [np.arange(low, high, 5.0) for low, high in ((-90, 95), (-90, 95), (-130, 90))]
    grid = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
    points = BASE_MM + grid.reshape(-1, 3) @ heart_axes(body)
    inside = np.isin(stuff_of(body, 0.0)(points), OF_HEART).reshape(grid.shape[:3])
    return np.asarray(points[(inside & ~binary_erosion(inside)).ravel()])


def _unit(vector: Float) -> Float:
    return np.asarray(vector / np.linalg.norm(vector))
