"""Muscle inside the ventricles, found in a cine of which everything is known."""

from __future__ import annotations

import ellipsoid_heart
import numpy as np
import pytest
from ellipsoid_heart import CENTRE_MM, PHASES, TILT, ellipsoids, moving_surfaces, record

from pipeline.errors import InputError
from pipeline.geometry import Float, Mask, MovingSurface, transform_points
from pipeline.imaging.cine import Cine
from pipeline.registration.frames import sample_frames
from pipeline.registration.similarity import agreement
from pipeline.registration.tissue_map import blurred, draw_tissue

PIXEL_MM, SLICE_MM = 2.0, 8.0
WALL_MM = 12.0
STORED = PHASES[::4]
"""The phases of the cine: fewer than the frames have, for speed."""
GREY = np.array([300.0, 150.0, 800.0])
"""Of what lies outside, muscle and blood."""


def in_papillary(points_mm: Float, phase: float) -> Mask:
    """A column of 8 mm radius on one wall of the left ventricle, along its axis."""
    local = (points_mm - CENTRE_MM) @ TILT
    axes = ellipsoids(phase)["lv_endocardium"][1]
    across = np.hypot(local[:, 0] - 0.75 * axes[0], local[:, 1])
    return (across < 8) & (np.abs(local[:, 2]) < 25)


def with_papillary(points_mm: Float, phase: float) -> Float:
    """Tissue of the heart with a papillary muscle in its left ventricle."""
    found = smooth_heart(points_mm, phase)
    return np.where((found == 2) & in_papillary(points_mm, phase), 1, found)


smooth_heart = ellipsoid_heart.tissue


def surfaces_with_epicardium() -> dict[str, MovingSurface]:
    """The left ventricle's outer surface beside the cavities."""
    surfaces = {
        name: MovingSurface(one.vertices_mm[::4], one.triangles, STORED)
        for name, one in moving_surfaces().items()
    }
    cavity = surfaces["lv_endocardium"]
    outer = []
    for phase, vertices in zip(STORED, cavity.vertices_mm, strict=True):
        centre, axes = ellipsoids(phase)["lv_endocardium"]
        unit = ((vertices - CENTRE_MM) @ TILT - centre) / axes
        outer.append((unit * (np.array(axes) + WALL_MM) + centre) @ TILT.T + CENTRE_MM)
    return {**surfaces, "epicardium": MovingSurface(np.array(outer), cavity.triangles, STORED)}


def cine_of(tissue, gain: float = 1.0) -> Cine:
    """Short-axis slices, each the mean of six levels of its thickness."""
    mr_from_index = np.eye(4)
    mr_from_index[:3, :3] = TILT * [PIXEL_MM, PIXEL_MM, SLICE_MM]
    mr_from_index[:3, 3] = CENTRE_MM + TILT @ [-80.0, -50.0, -56.0]
    k, j, i = np.mgrid[:20, :50, :65].reshape(3, -1)
    levels = (np.arange(6) + 0.5) / 6 - 0.5
    layers = [transform_points(mr_from_index, np.stack([i, j, k + level], 1)) for level in levels]
    pictures = [np.mean([GREY[tissue(layer, phase)] for layer in layers], 0) for phase in STORED]
    intensity = gain * np.array(pictures, np.float32).reshape(len(STORED), 20, 50, 65)
    return Cine(intensity, mr_from_index, STORED, 0.8)


@pytest.fixture(scope="module")
def surfaces():
    return surfaces_with_epicardium()


@pytest.fixture(scope="module")
def cine():
    return cine_of(with_papillary)


@pytest.fixture(scope="module")
def bare(surfaces):
    return draw_tissue(surfaces, 2.5)


@pytest.fixture(scope="module")
def drawn(surfaces, cine):
    return draw_tissue(surfaces, 2.5, cine)


def taken(bare, drawn, index: int) -> Float:
    """Share of every node that is no blood any more, one after the other."""
    return (bare.share - drawn.share)[index, ..., 0].ravel()


@pytest.mark.parametrize("index", [0, 2])
def test_papillary_muscle_is_no_blood_and_the_rest_stays_blood(bare, drawn, index):
    nodes = drawn.grid.nodes_mm().reshape(-1, 3)
    local = (nodes - CENTRE_MM) @ TILT
    centre, axes = ellipsoids(STORED[index])["lv_endocardium"]
    across = np.hypot(local[:, 0] - 0.75 * axes[0], local[:, 1])
    # A slice aslant to the wall holds some of it up to 3 mm inside, a pixel on either side more.
    deep = (((local - centre) / (np.array(axes) - 3 - PIXEL_MM)) ** 2).sum(axis=1) < 1
    lost = taken(bare, drawn, index)

    # A pixel inside its side and a slice and a half inside its ends, all voxels are muscle.
    core = deep & (across < 8 - 1.5 * PIXEL_MM) & (np.abs(local[:, 2]) < 25 - 1.5 * SLICE_MM)
    assert core.sum() > 20
    assert lost[core].min() > 0.9
    # Interpolation reaches one voxel further than the muscle, along each axis; beyond, only where
    # slices cut the apex can the expected share be off.
    away = (across > 8 + 2 * PIXEL_MM) | (np.abs(local[:, 2]) > 25 + 1.5 * SLICE_MM)
    assert lost[away].sum() < 0.05 * lost.sum()


def test_smooth_cavities_are_all_blood_however_thick_the_slices(surfaces, bare):
    """Where a voxel holds wall as well, the surfaces let expect it."""
    drawn = draw_tissue(surfaces, 2.5, cine_of(smooth_heart))
    blood, lost = bare.share[..., 0], bare.share[..., 0] - drawn.share[..., 0]
    # Where slices cut the apex, coverage by nodes 2.5 mm apart is a little off.
    assert lost.sum() < 0.002 * blood.sum()


def test_gain_does_not_matter(surfaces, drawn):
    louder = draw_tissue(surfaces, 2.5, cine_of(with_papillary, gain=7.0))
    np.testing.assert_allclose(louder.share, drawn.share, atol=1e-4)


def test_without_epicardium_muscle_is_unknown(surfaces, bare, cine):
    cavities = {name: one for name, one in surfaces.items() if name != "epicardium"}
    np.testing.assert_array_equal(draw_tissue(cavities, 2.5, cine).share, bare.share)


def test_cine_of_other_phases_is_refused(surfaces, cine):
    other = Cine(cine.intensity[::2], cine.mr_from_index, STORED[::2], 0.8)
    with pytest.raises(InputError, match="4 phases are not the 2 of the cine"):
        draw_tissue(surfaces, 2.5, other)


def test_frames_agree_better_with_the_muscle_that_they_show(bare, drawn, monkeypatch):
    monkeypatch.setattr(ellipsoid_heart, "tissue", with_papillary)
    recording = record(seed=3)
    samples = sample_frames(recording.sweeps, recording.phases, 4.0, 1.5, 20.0)
    smooth, known = (
        agreement(samples, blurred(one, 1.5), recording.mr_from_tracker).score
        for one in (bare, drawn)
    )
    assert known > smooth
