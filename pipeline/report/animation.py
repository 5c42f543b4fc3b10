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

from pipeline.geometry import MovingSurface

COLOURS = {
    "epicardium": "#C0504D",
    "rv_endocardium": "#009E73",
    "left_atrium": "#D9B800",
    "right_atrium": "#CC79A7",
    "aorta": "#D55E00",
}
FRAMES = 12
SIZE_PIXELS = (440, 440)
TIME_LIMIT_S = 90


def beating_surfaces(surfaces: Mapping[str, MovingSurface], rr_s: float) -> bytes | None:
    """Animated WebP of one heartbeat, or None where this machine cannot draw in 3D."""
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        _hand_over(work / "surfaces.npz", surfaces)
        command = [sys.executable, "-m", "pipeline.report.animation", str(work)]
        try:
            done = subprocess.run(command, capture_output=True, timeout=TIME_LIMIT_S, check=False)
        except subprocess.TimeoutExpired:
            return None
        if done.returncode != 0:
            return None
        frames = np.load(work / "frames.npy")
    return _webp(frames, rr_s)


def _hand_over(path: Path, surfaces: Mapping[str, MovingSurface]) -> None:
    arrays: dict[str, Any] = {}
    for name, moving in surfaces.items():
        if name in COLOURS:
            count = len(moving.phases)
            chosen = np.unique(np.linspace(0, count, FRAMES, endpoint=False).astype(int))
            arrays[f"{name}.vertices"] = moving.vertices_mm[chosen]
            arrays[f"{name}.triangles"] = moving.triangles
    np.savez(path, **arrays)


def _webp(frames: Any, rr_s: float) -> bytes:
    from PIL import Image

    images = [Image.fromarray(frame) for frame in frames]
    buffer = BytesIO()
    images[0].save(
        buffer,
        format="WEBP",
        save_all=True,
        append_images=images[1:],
        duration=round(1000 * rr_s / len(images)),
        loop=0,
        quality=70,
    )
    return buffer.getvalue()


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
        plotter.add_mesh(mesh, color=COLOURS[name])
    # Seen from the patient's front left (LPS: left is +x, anterior is -y), head up.
    plotter.view_vector((0.5, -1.0, 0.25), viewup=(0, 0, 1))
    plotter.camera.zoom(1.4)
    frames = []
    for number in range(len(arrays[f"{names[0]}.vertices"])):
        for name, mesh in meshes.items():
            mesh.points = arrays[f"{name}.vertices"][number]
        plotter.render()
        frames.append(plotter.screenshot(return_img=True))
    np.save(work / "frames.npy", np.stack(frames))


if __name__ == "__main__":
    _draw(Path(sys.argv[1]))
