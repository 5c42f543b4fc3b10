"""What one frame hears: the tissues in front of the probe, and the scatterers they carry along."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from data_synth.echo import bmode, unit_noise
from data_synth.probe import Probe
from data_synth.sector import Sector
from data_synth.speckle import Hearing, Scatterers, draw_scatterers, gather, hearing
from data_synth.tissue import Tissue
from data_synth.window import Anatomy, labels_before, opened, place

Float = npt.NDArray[np.float64]
Byte = npt.NDArray[np.uint8]
Complex = npt.NDArray[np.complex128]

_BLOOD = (
    Tissue.LV_CAVITY,
    Tissue.RV_CAVITY,
    Tissue.LEFT_ATRIUM,
    Tissue.RIGHT_ATRIUM,
    Tissue.AORTA,
    Tissue.BLOOD_VESSEL,
)
"""Flows by several beam widths from one frame to the next: no echo of it is seen twice."""
_AT_REST = (
    Tissue.AIR,
    Tissue.MUSCLE,
    Tissue.LUNG,
    Tissue.BONE,
    Tissue.LIVER,
    Tissue.STOMACH,
    Tissue.GAS,
    Tissue.SPLEEN,
)
_NODE_STEP = 8
"""Samples from one node to the next along range and beams, where the motion is worked out; it is
smooth over centimetres, so that straight lines between nodes are good to a tenth of a cell."""
_ACROSS_MM = 2.0


@dataclass(frozen=True, slots=True)
class View:
    """A body in front of a probe."""

    heart: Anatomy
    probe: Probe
    slice_mm: Float
    """``(ranges,)`` thickness of the beam across the picture's plane, standard deviation."""

    scatterers: Scatterers
    hearing: Hearing


def draw_view(
    rng: np.random.Generator, heart: Anatomy, probe: Probe, slice_mm: float | None
) -> View:
    """A body with scatterers of its own; ``slice_mm`` is the beam's thickness at its lens's focus,
    the probe's own if None."""
    thickness_mm, parts = _thickness(probe, slice_mm)
    return View(heart, probe, thickness_mm, draw_scatterers(rng, _cell_mm(probe)), parts)


def _cell_mm(probe: Probe) -> float:
    """Cells finer than this would not be heard apart."""
    return max(1.2 * probe.optics.pulse_mm, 0.4)


@lru_cache(maxsize=8)
def _thickness(probe: Probe, slice_mm: float | None) -> tuple[Float, Hearing]:
    """Thickness of the beam by range, and which parts of it are heard how loudly."""
    optics, sector = probe.optics, probe.sector
    thickness_mm = optics.slice_mm(sector.ranges_mm)
    if slice_mm is not None:
        at_focus = optics.slice_mm(np.array([optics.slice_focus_mm]))
        thickness_mm = thickness_mm * slice_mm / at_focus
    return thickness_mm, hearing(sector, optics, thickness_mm, _cell_mm(probe))


def show(
    rng: np.random.Generator,
    view: View,
    mr_from_transducer: Float,
    phase: float,
    moved_mm: Float,
    contact_db: Float,
) -> Byte:
    """The picture at one pose and nominal phase, the heart moved by ``moved_mm`` ``(3,)``."""
    sector, probe = view.probe.sector, view.probe
    # A beam hears a slice, not a plane: each sample's tissue comes from somewhere across it.
    local = sector.points_mm.copy()
    local[..., 2] += view.slice_mm[:, None] * np.clip(rng.normal(size=local.shape[:2]), -2, 2)
    points_mm = place(local, mr_from_transducer)
    labels = opened(labels_before(view.heart, points_mm, phase, moved_mm), sector, probe)
    echoes = carried_echoes(view, mr_from_transducer, phase, moved_mm, labels)
    fresh = np.isin(labels, _BLOOD)
    echoes[fresh] = unit_noise(rng, (int(fresh.sum()),))
    return bmode(rng, labels, sector, contact_db, probe.optics, echoes)


def carried_echoes(
    view: View, mr_from_transducer: Float, phase: float, moved_mm: Float, labels: Byte
) -> Complex:
    """Echoes of the scatterers at every sample, those of the heart where the heart took them."""
    sector = view.probe.sector
    here = place(sector.points_mm, mr_from_transducer)
    middle, across = _rest_places(view.heart, sector, mr_from_transducer, phase, moved_mm)
    still = np.isin(labels, _AT_REST)
    middle[still] = here[still]
    across[still] = mr_from_transducer[:3, 2]
    beside = _beside(middle, sector)
    beside[still] = _beside(here, sector)[still]
    cell_mm = view.scatterers.cell_mm
    return gather(
        middle / cell_mm,
        beside / cell_mm,
        across / cell_mm,
        view.hearing.offsets_mm,
        view.hearing.weights,
        view.scatterers.echoes,
    )


def _rest_places(
    heart: Anatomy, sector: Sector, mr_from_transducer: Float, phase: float, moved_mm: Float
) -> tuple[Float, Float]:
    """``(ranges, beams, 3)`` each: where samples are at rest, and how that changes across a mm."""
    nodes = [_nodes(count) for count in sector.points_mm.shape[:2]]
    planes = np.repeat(sector.points_mm[np.ix_(*nodes)][None], 2, axis=0)
    planes[1, ..., 2] += _ACROSS_MM
    points_mm = place(planes, mr_from_transducer) - moved_mm
    rest = heart.reference(points_mm.reshape(-1, 3), phase).reshape(planes.shape)
    rest[1] = (rest[1] - rest[0]) / _ACROSS_MM
    along, beams = (
        _between(own, count) for own, count in zip(nodes, sector.points_mm.shape[:2], strict=True)
    )
    middle, across = np.einsum("rn,pnmc,bm->prbc", along, rest, beams, optimize=True)
    return middle, across


def _nodes(count: int) -> npt.NDArray[np.int64]:
    return np.unique(np.append(np.arange(0, count, _NODE_STEP), count - 1))


def _between(nodes: npt.NDArray[np.int64], count: int) -> Float:
    """``(count, nodes)`` weights of linear interpolation."""
    return np.stack([np.interp(np.arange(count), nodes, one) for one in np.eye(len(nodes))], axis=1)


def _beside(places: Float, sector: Sector) -> Float:
    """Change of the place with a way of 1 mm to the next beam."""
    spacing_mm = sector.ranges_mm * (sector.angles_rad[1] - sector.angles_rad[0])
    return np.asarray(np.gradient(places, axis=1) / spacing_mm[:, None, None])
