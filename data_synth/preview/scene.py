"""The heart's surfaces and the probe's path, drawn in three dimensions.

VTK ends the whole process where a machine has no way to draw off-screen, so it draws in a process
of its own, and the page does without these pictures where that fails.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from data_synth.kernels import Float
from data_synth.meshes import Mesh
from data_synth.preview.style import STYLES

# The muscle is grey: shades of its light blue would be taken for the aorta's blue.
COLOURS = {
    "epicardium": "#A0A0A0",
    "lv_endocardium": STYLES["lv_cavity"][0],
    "rv_endocardium": STYLES["rv_cavity"][0],
    "left_atrium": STYLES["left_atrium"][0],
    "right_atrium": STYLES["right_atrium"][0],
    "aorta": STYLES["aorta"][0],
}
SHORT = {
    "epicardium": "LV",
    "lv_endocardium": "LV",
    "rv_endocardium": "RV",
    "left_atrium": "LA",
    "right_atrium": "RA",
    "aorta": "Ao",
}
NAMED = {
    "front": ("epicardium", "rv_endocardium", "left_atrium", "right_atrium", "aorta"),
    "back": ("epicardium", "left_atrium", "right_atrium", "aorta"),
    "cut": ("lv_endocardium", "rv_endocardium", "left_atrium", "right_atrium"),
}
"""View -> meshes that bear their short name in it: those that are seen from there."""
PROBES = {"#222222": "black", "#7B3294": "purple", "#8C510A": "brown"}
"""Of sweeps: none is that of a chamber."""
SIZE_PIXELS = (460, 460)
TIME_LIMIT_S = 120
# LPS: left is +x, anterior is -y, head is +z.
FRONT, BACK, LEFT = (0.35, -1.0, 0.2), (0.6, 1.0, 0.3), (1.0, 0.15, 0.25)
FANS_SHOWN = 4
HEART_SPAN, SWEEP_SPAN = 0.78, 1.15
"""A picture's height over the heart's diagonal; the same at every moment."""
CAP_MM = 0.5
"""How far a cavity stands out of the cut through the muscle around it, so that it is seen."""

Picture = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Fans:
    """Where a sweep's pictures lie, and one of them."""

    outlines_mm: Float
    """``(frames, points, 3)`` LPS outline of each picture, the tip first."""
    corners_mm: Float
    """``(3, 3)`` LPS of the shown picture's corners: upper left, upper right, lower left."""
    image: Picture
    """``(rows, columns, 4)`` the picture shown, and how opaque each pixel is."""


def draw_scenes(
    moments: Mapping[str, Mapping[str, Mesh]], rotation: Float, fans: Mapping[str, Fans]
) -> dict[str, Picture]:
    """Pictures by name; none where this machine cannot draw in three dimensions.

    Parameters
    ----------
    moments
        Moment's name -> truth meshes then; each gives ``front``, ``back`` and ``cut`` views.
    rotation
        ``(3, 3)`` columns are the heart frame's axes in LPS; the cut holds the first and third.
    fans
        What each sweep looked at.
    """
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        _hand_over(work / "scene.npz", moments, rotation, fans)
        # Not from the folder in which the user happens to be.
        command = [sys.executable, "-P", "-m", "data_synth.preview.scene", str(work)]
        try:
            done = subprocess.run(command, capture_output=True, timeout=TIME_LIMIT_S, check=False)
        except subprocess.TimeoutExpired:
            return {}
        if done.returncode != 0:
            return {}
        return dict(np.load(work / "pictures.npz"))


def _hand_over(
    path: Path,
    moments: Mapping[str, Mapping[str, Mesh]],
    rotation: Float,
    fans: Mapping[str, Fans],
) -> None:
    arrays: dict[str, Any] = {"rotation": rotation}
    for moment, meshes in moments.items():
        for name in COLOURS:
            points, triangles = meshes[name]
            arrays[f"mesh/{moment}/{name}/points"] = points
            arrays[f"mesh/{moment}/{name}/triangles"] = triangles
    for sweep, fan in fans.items():
        arrays[f"fan/{sweep}/outlines"] = fan.outlines_mm
        arrays[f"fan/{sweep}/corners"] = fan.corners_mm
        arrays[f"fan/{sweep}/image"] = fan.image
    np.savez(path, **arrays)


def _draw(work: Path) -> None:
    """Draw all pictures that the file asks for; runs in the process of its own."""
    with np.load(work / "scene.npz") as stored:
        arrays = dict(stored)
    moments = _meshes(arrays)
    first = next(iter(moments.values()))
    centre, size_mm = _frame(first)
    # The ascending aorta leaves the plane of the cut.
    middle, _ = _frame({name: mesh for name, mesh in first.items() if name != "aorta"})
    pictures: dict[str, Any] = {}
    for moment, meshes in moments.items():
        for side, seen_from in (("front", FRONT), ("back", BACK)):
            plotter = _surfaces(meshes, NAMED[side])
            pictures[f"{moment}/{side}"] = _shot(
                plotter, centre, HEART_SPAN * size_mm, seen_from, (0, 0, 1)
            )
        plotter, toward = _cut(meshes, arrays["rotation"])
        # Apex down, as four-chamber views are shown.
        up = tuple(arrays["rotation"][:, 2])
        pictures[f"{moment}/cut"] = _shot(plotter, middle, HEART_SPAN * size_mm, toward, up)
    fans = sorted({key.rsplit("/", 1)[0] for key in arrays if key.startswith("fan/")})
    for side, seen_from in (("front", FRONT), ("left", LEFT)) if fans else ():
        # Pictures hung in both views would hide most of the heart.
        plotter = _sweeps(first, [_fan(arrays, name) for name in fans], hung=side == "left")
        pictures[f"sweep/{side}"] = _shot(
            plotter, centre, SWEEP_SPAN * size_mm, seen_from, (0, 0, 1)
        )
    np.savez(work / "pictures.npz", **pictures)


def _frame(meshes: dict[str, Any]) -> tuple[Float, float]:
    """Middle of all meshes, and the diagonal of the box around them (mm)."""
    points = np.concatenate([mesh.points for mesh in meshes.values()])
    low, high = points.min(axis=0), points.max(axis=0)
    return (low + high) / 2, float(np.linalg.norm(high - low))


def _meshes(arrays: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Moment -> name -> VTK mesh, in the order in which they were handed over."""
    import pyvista

    moments: dict[str, dict[str, Any]] = {}
    for key, points in arrays.items():
        if key.endswith("/points"):
            _, moment, name, _ = key.split("/")
            triangles = arrays[f"mesh/{moment}/{name}/triangles"]
            mesh = pyvista.PolyData.from_regular_faces(points, triangles)
            moments.setdefault(moment, {})[name] = mesh
    return moments


def _fan(arrays: dict[str, Any], name: str) -> Fans:
    return Fans(*(arrays[f"{name}/{part}"] for part in ("outlines", "corners", "image")))


def _plotter() -> Any:
    import pyvista

    plotter = pyvista.Plotter(off_screen=True, window_size=SIZE_PIXELS)
    plotter.enable_anti_aliasing("ssaa")
    return plotter


def _surfaces(meshes: dict[str, Any], named: tuple[str, ...]) -> Any:
    plotter = _plotter()
    for name, colour in COLOURS.items():
        plotter.add_mesh(meshes[name], color=colour, smooth_shading=True)
    _name_parts(plotter, {name: meshes[name].center for name in named})
    return plotter


def _cut(meshes: dict[str, Any], rotation: Float) -> tuple[Any, tuple[float, ...]]:
    """The heart laid open along the plane of the long axis and the right ventricle; its normal."""
    plotter = _plotter()
    normal = rotation[:, 1]
    toward = -normal if normal[1] > 0 else normal
    middle = np.asarray(meshes["epicardium"].center)
    places: dict[str, Any] = {}
    for name, colour in COLOURS.items():
        stand = CAP_MM if name != "epicardium" else 0.0
        half = meshes[name].clip_closed_surface(-toward, middle + stand * toward)
        if half.n_points:
            plotter.add_mesh(half, color=colour, ambient=0.15)
            face = (half.points - middle) @ toward > stand - 0.01
            places[name] = half.points[face].mean(axis=0) if face.any() else half.center
    _name_parts(plotter, {name: places[name] for name in NAMED["cut"] if name in places})
    return plotter, tuple(toward)


def _sweeps(meshes: dict[str, Any], fans: list[Fans], hung: bool) -> Any:
    """The heart, half transparent; probe paths, outlines of a few pictures, one of them hung."""
    import pyvista

    plotter = _plotter()
    for name, colour in COLOURS.items():
        if name != "lv_endocardium":
            plotter.add_mesh(meshes[name], color=colour, opacity=0.45)
    for fan, colour in zip(fans, PROBES, strict=False):
        shown = np.linspace(0, len(fan.outlines_mm) - 1, FANS_SHOWN).round().astype(int)
        for outline in fan.outlines_mm[shown]:
            closed = np.vstack([outline, outline[:1]])
            plotter.add_mesh(pyvista.MultipleLines(closed), color=colour, line_width=2)
        path = fan.outlines_mm[:, 0]
        if len(path) > 1:
            plotter.add_mesh(pyvista.MultipleLines(path), color=colour, line_width=6)
        if hung:
            _hang(plotter, fan)
    return plotter


def _hang(plotter: Any, fan: Fans) -> None:
    """Hang one picture where it was taken."""
    import pyvista

    corner, right, down = fan.corners_mm
    points = np.array([corner, right, right + down - corner, down])
    plane = pyvista.PolyData(points, faces=[4, 0, 1, 2, 3])
    plane.active_texture_coordinates = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], np.float32)
    plotter.add_mesh(plane, texture=pyvista.Texture(fan.image), lighting=False)


def _name_parts(plotter: Any, places: dict[str, Any]) -> None:
    plotter.add_point_labels(
        np.array(list(places.values())),
        [SHORT[name] for name in places],
        font_size=18,
        text_color="black",
        shape_color="white",
        shape_opacity=0.7,
        show_points=False,
        always_visible=True,
    )


def _shot(
    plotter: Any, centre: Float, span_mm: float, seen_from: tuple[float, ...], up: tuple[float, ...]
) -> Any:
    plotter.set_background("white")
    plotter.enable_parallel_projection()
    plotter.view_vector(seen_from, viewup=up)
    plotter.camera.focal_point = centre
    plotter.camera.position = centre + 500 * np.asarray(seen_from) / np.linalg.norm(seen_from)
    plotter.camera.parallel_scale = span_mm / 2
    plotter.reset_camera_clipping_range()
    picture = plotter.screenshot(return_img=True)
    plotter.close()
    return picture


if __name__ == "__main__":
    _draw(Path(sys.argv[1]))
