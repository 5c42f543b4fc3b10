"""Muscle inside the cavities, as the cine shows it: papillary muscles and trabeculae.

Surfaces of ventricles are smooth, as readers draw them: papillary muscles and trabeculae count as
blood (S. E. Petersen et al., "Reference ranges for cardiac structure and function using
cardiovascular magnetic resonance (CMR) in Caucasians from the UK Biobank population cohort", J
Cardiovasc Magn Reson 19 (2017) 18). Ultrasound shows them as bright as the wall that they grow on,
so that its border of blood lies millimetres inside the surface, on one side more than on the other.
In the cine they are dark in bright blood. What is darker than the surfaces let expect of a voxel
as thick as a slice is taken for muscle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.ndimage import map_coordinates

from pipeline.errors import InputError
from pipeline.geometry import Float, Float32, Grid, transform_points
from pipeline.imaging.cine import Cine

VENTRICLES = ("lv_endocardium", "rv_endocardium")
"""The cavities that hold muscle."""

# A slice is looked at in thirds, at the middle of each.
_THIRDS = (-1 / 3, 0.0, 1 / 3)
# From here on a voxel is all of one kind; under the lower share it has next to nothing of it.
_ALL, _NONE = 0.95, 0.05
# A voxel with less of it in a ventricle lies at the rim, where the surface's own error decides.
_LEAST_INSIDE = 0.3
# Noise, slow or turbulent blood and the surface's own error darken a voxel by this share of the
# way from blood to muscle: only what is darker counts, from nothing there to all at muscle's grey.
_DOUBTFUL = 0.3
# Fewer voxels than this give no level of grey.
_LEAST_VOXELS = 20


@dataclass(frozen=True, slots=True)
class CineOnGrid:
    """The cine's voxels around the heart, and how they and the nodes of a grid lie."""

    intensity: Float32
    """``(phase, slice, row, column)``."""

    grid_from_voxel: Float
    """``(3, 3, voxels)``: for each third of a slice, the voxels' place in the grid, nodes along
    ``z, y, x``."""

    voxel_from_grid: Float
    """``(3, nodes)``: slice, row and column of every node."""

    @classmethod
    def of(cls, cine: Cine, phases: Float, grid: Grid) -> Self:
        """The voxels that lie in the grid.

        Raises
        ------
        InputError
            When the cine has not the phases ``phases``.
        """
        if not np.array_equal(cine.phases, phases):
            raise InputError(
                f"the surfaces' {len(phases)} phases are not the {len(cine.phases)} of the cine; "
                "needs surfaces that were found in this cine"
            )
        index_from_mr = np.asarray(np.linalg.inv(cine.mr_from_index))
        nodes = transform_points(index_from_mr, grid.nodes_mm().reshape(-1, 3))
        slices, height, width = cine.intensity.shape[1:]
        lower = np.clip(np.floor(nodes.min(axis=0)), 0, [width, height, slices]).astype(int)
        upper = np.clip(np.ceil(nodes.max(axis=0)) + 1, 0, [width, height, slices]).astype(int)
        (i0, j0, k0), (i1, j1, k1) = lower, upper
        k, j, i = np.mgrid[k0:k1, j0:j1, i0:i1].reshape(3, -1)
        thirds = [np.stack([i, j, k + third], axis=1).astype(float) for third in _THIRDS]
        grid_from_voxel = [
            (transform_points(cine.mr_from_index, third) - grid.origin_mm) / grid.spacing_mm
            for third in thirds
        ]
        return cls(
            cine.intensity[:, k0:k1, j0:j1, i0:i1],
            np.stack([places[:, ::-1].T for places in grid_from_voxel]),
            (nodes - lower)[:, ::-1].T,
        )

    def in_voxels(self, share: Float32) -> Float:
        """``(slice, row, column)``: share of each voxel, from that of the grid's nodes."""
        return _mean_at(self.grid_from_voxel, share).reshape(self.intensity.shape[1:])

    def grey_of_muscle(self, heart: Float32, blood: Float32) -> float | None:
        """Median grey in the first phase where there is heart and no blood; None where too few
        voxels are all muscle."""
        muscle = (self.in_voxels(heart) > _ALL) & (self.in_voxels(blood) < _NONE)
        if muscle.sum() < _LEAST_VOXELS:
            return None
        return float(np.median(self.intensity[0][muscle]))

    def muscle_inside(
        self, index: int, blood: Float32, ventricles: Float32, grey_of_muscle: float
    ) -> Float32:
        """Share of every node that is muscle within the ventricles, ``(z, y, x)``.

        Parameters
        ----------
        index
            Number of the phase.
        blood, ventricles
            ``(z, y, x)`` shares of all cavities and of the ventricles alone, by their surfaces.
        """
        inside = self.in_voxels(ventricles)
        looked_at = inside > _LEAST_INSIDE
        expected, muscle = np.zeros(inside.shape), np.zeros(inside.shape)
        expected[looked_at] = _mean_at(self.grid_from_voxel[:, :, looked_at.ravel()], blood)
        for number, picture in enumerate(self.intensity[index]):
            deep = inside[number] > _ALL
            if deep.sum() < _LEAST_VOXELS:
                continue
            # Each slice has a level of its own: coils lie near it or far. Most of it is blood.
            contrast = np.percentile(picture[deep], 75) - grey_of_muscle
            if contrast > 0:
                missing = expected[number] - (picture - grey_of_muscle) / contrast
                missing = np.clip((missing - _DOUBTFUL) / (1 - _DOUBTFUL), 0, 1)
                muscle[number] = np.where(looked_at[number], missing, 0)
        share, within = np.zeros_like(ventricles), ventricles > 0
        places = self.voxel_from_grid[:, within.ravel()]
        share[within] = map_coordinates(muscle, places, order=1, mode="nearest")
        return np.minimum(share, ventricles)


def _mean_at(places: Float, share: Float32) -> Float:
    """``(n,)``: mean of a share over the ``(3, 3, n)`` places of each voxel."""
    return np.asarray(np.mean([map_coordinates(share, one, order=1) for one in places], axis=0))
