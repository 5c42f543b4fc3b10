"""How truly the vertices of a run's surfaces follow the material, where truth is known.

    python benchmarks/surface_motion.py STUDY PRODUCTS [STUDY PRODUCTS ...]

STUDY is a synthetic study, PRODUCTS the folder of its products (OUT/patient-0001). A vertex's place
at the first phase is attached to the nearest triangle of the true mesh, whose corners are the same
material points in every phase; from there on the way that the vertex goes is compared with the way
of that material point. The miss is split along the true surface's normal and across it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pyvista

from pipeline.geometry import Float, MovingSurface
from pipeline.meshes import read_mesh
from pipeline.products import read_surfaces, read_table


def read_true(study: Path, name: str, phases: Float) -> MovingSurface:
    """The true surface of a structure through the beat."""
    folder = study / "truth" / "surfaces"
    each = [read_mesh(folder / f"{name}_{k:03d}.vtp") for k in range(len(phases))]
    return MovingSurface(np.stack([one.vertices_mm for one in each]), each[0].triangles, phases)


def material_ways(found: MovingSurface, true: MovingSurface) -> tuple[Float, Float]:
    """True displacement and normal, both ``(phase, n, 3)``, of what lies under each vertex."""
    mesh = pyvista.PolyData.from_regular_faces(true.vertices_mm[0], true.triangles)
    cells, feet = mesh.find_closest_cell(found.vertices_mm[0], return_closest_point=True)
    corners = true.triangles[cells]
    a, b, c = (true.vertices_mm[0][corners[:, k]] for k in range(3))
    whole = np.cross(b - a, c - a)
    square = np.maximum(np.einsum("ij,ij->i", whole, whole), 1e-12)
    share_b = np.einsum("ij,ij->i", np.cross(feet - a, c - a), whole) / square
    share_c = np.einsum("ij,ij->i", np.cross(b - a, feet - a), whole) / square
    shares = np.stack([1 - share_b - share_c, share_b, share_c], axis=1)
    ways, normals = [], []
    for vertices in true.vertices_mm:
        ways.append(np.einsum("nk,nki->ni", shares, vertices[corners]) - feet)
        surface = pyvista.PolyData.from_regular_faces(vertices, true.triangles)
        surface = surface.compute_normals(cell_normals=False, split_vertices=False)
        mean = np.einsum("nk,nki->ni", shares, surface.point_data["Normals"][corners])
        normals.append(mean / np.linalg.norm(mean, axis=1, keepdims=True))
    return np.stack(ways), np.stack(normals)


def split(vectors: Float, normals: Float) -> tuple[Float, Float]:
    """Sizes ``(phase, n)`` of vectors along unit normals and across them."""
    along = np.einsum("pni,pni->pn", vectors, normals)
    return np.abs(along), np.linalg.norm(vectors - along[..., None] * normals, axis=2)


def figures(found: MovingSurface, true: MovingSurface) -> dict[str, float]:
    """Miss of the motion in mm over all phases but the first, and what there was to miss."""
    ways, normals = material_ways(found, true)
    miss = found.vertices_mm - found.vertices_mm[0] - ways
    normal, tangential = split(miss[1:], normals[1:])
    normal_motion, tangential_motion = split(ways[1:], normals[1:])
    return {
        "normal": float(normal.mean()),
        "worst phase": float(normal.mean(axis=1).max()),
        "normal 95 %": float(np.percentile(normal, 95)),
        "tangential": float(tangential.mean()),
        "tangential 95 %": float(np.percentile(tangential, 95)),
        "true normal": float(normal_motion.mean()),
        "true tangential": float(tangential_motion.mean()),
    }


def main() -> None:
    """Print one row a structure and study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+", metavar="STUDY PRODUCTS")
    folders = parser.parse_args().folders
    header: list[str] = []
    for study, products in zip(folders[::2], folders[1::2], strict=True):
        phases = np.array(read_table(products / "ingest" / "phases.json")["phases"])
        for name, found in read_surfaces(products / "surface", phases).items():
            row = figures(found, read_true(study, name, phases))
            if not header:
                header = [*row]
                print(f"| mm | {' | '.join(header)} |\n{'|---' * (len(header) + 1)}|")
            values = " | ".join(f"{row[key]:.2f}" for key in header)
            print(f"| {study.name} {name} | {values} |", flush=True)


if __name__ == "__main__":
    main()
