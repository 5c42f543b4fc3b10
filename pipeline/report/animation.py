"""The beating surfaces as an animation.

VTK ends the whole process where a machine has no way to draw off-screen, so it draws in a process
of its own, and the report does without the animation where that fails.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import StageError
from pipeline.geometry import Float, Float32, MovingSurface
from pipeline.report.colours import SOLID_COLOURS
from pipeline.report.style import as_moving_webp

FRAMES = 20
SIZE_PIXELS = (520, 520)
TIME_LIMIT_S = 300

# Seen from the patient's front left (LPS: left is +x, anterior is -y), head up.
TOWARDS_VIEWER = np.array([0.5, -1.0, 0.25])
HEAD = np.array([0.0, 0.0, 1.0])
NO_ROOM = 28
"""The drawing process ends with this where its pictures cannot be written."""
ROOM = 1.06
"""The picture is this much larger than what moves in it."""


class NoAnimation(Exception):
    """Why there is none, as where a machine cannot draw in 3D."""


def beating_surfaces(surfaces: Mapping[str, MovingSurface], rr_s: float) -> bytes:
    """Animated WebP of one heartbeat.

    Raises
    ------
    NoAnimation
        When it cannot be drawn here.
    StageError
        When there is no room for temporary files.
    """
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        try:
            _hand_over(work / "surfaces.npz", surfaces)
        except OSError as error:
            raise _no_room() from error
        # Not from the folder in which the user happens to be.
        command = [sys.executable, "-P", "-m", "pipeline.report.animation", str(work)]
        try:
            done = subprocess.run(command, capture_output=True, timeout=TIME_LIMIT_S, check=False)
        except subprocess.TimeoutExpired:
            raise NoAnimation(f"to draw it took more than {TIME_LIMIT_S} s") from None
        if done.returncode == NO_ROOM:
            raise _no_room()
        if done.returncode != 0:
            said = done.stderr.decode(errors="replace").strip().splitlines()
            why = said[-1] if said else f"the process that draws ended with {done.returncode}"
            raise NoAnimation(f"this machine cannot draw in 3D ({why})")
        frames = np.load(work / "frames.npy")
    return _webp(frames, rr_s)


def _no_room() -> StageError:
    return StageError(
        f"{tempfile.gettempdir()}: temporary files of the animation cannot be written; free some "
        "space there, or name a place that has some in TMPDIR"
    )


def _hand_over(path: Path, surfaces: Mapping[str, MovingSurface]) -> None:
    arrays: dict[str, Any] = {}
    for name, moving in surfaces.items():
        if name in SOLID_COLOURS:
            arrays[f"{name}.vertices"] = even_in_time(moving, FRAMES)
            arrays[f"{name}.triangles"] = moving.triangles
    np.savez(path, **arrays)


def even_in_time(moving: MovingSurface, count: int) -> Float32:
    """Vertices ``(count, n, 3)`` at even steps of one beat, straight between stored phases.

    Vertices correspond, so a few phases, unevenly spaced, still make an even motion; the last
    phase leads back to the first.
    """
    wanted = moving.phases[0] + np.arange(count) / count
    return np.stack([vertices_at(moving, phase) for phase in wanted]).astype(np.float32)


def vertices_at(moving: MovingSurface, phase: float) -> Float:
    """Vertices ``(n, 3)``, mm, on straight lines between the stored phases, at a phase that counts
    from the first of these up to one beat later."""
    ends = np.append(moving.phases, moving.phases[0] + 1)
    before = int(np.searchsorted(ends, phase, side="right")) - 1
    share = (phase - ends[before]) / (ends[before + 1] - ends[before])
    after = (before + 1) % len(moving.phases)
    return np.asarray((1 - share) * moving.vertices_mm[before] + share * moving.vertices_mm[after])


def axes_of_view(towards_viewer: Float) -> Float:
    """``(3, 3)`` unit vectors to a far viewer's right, up (the patient's head) and towards them."""
    towards = towards_viewer / np.linalg.norm(towards_viewer)
    right = np.cross(HEAD, towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def framing(points_mm: Float) -> tuple[Float, float]:
    """Where a parallel camera looks, and half the height it must see, for all points to show.

    Parameters
    ----------
    points_mm
        ``(n, 3)``; everything that is to be in the picture, at all times.
    """
    axes = axes_of_view(TOWARDS_VIEWER)
    seen = points_mm @ axes.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    wide, tall, _ = (high - low) / 2
    half_mm = ROOM * max(tall, wide * SIZE_PIXELS[1] / SIZE_PIXELS[0])
    return np.asarray((low + high) / 2 @ axes), float(half_mm)


def first_frame(animation: bytes) -> bytes:
    """The animation at rest, as WebP."""
    from PIL import Image

    buffer = BytesIO()
    with Image.open(BytesIO(animation)) as moving:
        moving.convert("RGB").save(buffer, format="WEBP", quality=70)
    return buffer.getvalue()


def _webp(frames: Any, rr_s: float) -> bytes:
    from PIL import Image

    images = [Image.fromarray(frame) for frame in frames]
    return as_moving_webp(images, round(1000 * rr_s / len(images)), quality=70)


def _draw(work: Path) -> None:
    import pyvista

    arrays = np.load(work / "surfaces.npz")
    names = sorted({key.split(".")[0] for key in arrays.files})
    plotter = pyvista.Plotter(off_screen=True, window_size=SIZE_PIXELS)
    meshes = {}
    for name in names:
        mesh = pyvista.PolyData.from_regular_faces(
            arrays[f"{name}.vertices"][0], arrays[f"{name}.triangles"]
        )
        meshes[name] = mesh
        plotter.add_mesh(mesh, color=SOLID_COLOURS[name])
    everything = [arrays[f"{name}.vertices"].reshape(-1, 3) for name in names]
    centre_mm, half_mm = framing(np.concatenate(everything))
    plotter.view_vector(TOWARDS_VIEWER, viewup=HEAD)
    plotter.enable_parallel_projection()
    plotter.camera.focal_point = centre_mm
    plotter.camera.position = centre_mm + 500 * TOWARDS_VIEWER
    plotter.camera.parallel_scale = half_mm
    plotter.camera.clipping_range = (1, 2000)
    frames = []
    for number in range(len(arrays[f"{names[0]}.vertices"])):
        for name, mesh in meshes.items():
            mesh.points = arrays[f"{name}.vertices"][number]
        plotter.render()
        frames.append(plotter.screenshot(return_img=True))
    try:
        np.save(work / "frames.npy", np.stack(frames))
    except OSError:
        sys.exit(NO_ROOM)


if __name__ == "__main__":
    _draw(Path(sys.argv[1]))
