"""The one door to compiled code, and the values that compiled code reads."""

from __future__ import annotations

import atexit
import hashlib
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple, ParamSpec, TypeVar, cast

import numpy as np
import numpy.typing as npt
from numba import config, njit

Float = npt.NDArray[np.float64]
Label = npt.NDArray[np.uint8]
Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

# Compiled functions, and the numbers that they take for constants.
_SOURCES = (
    *("kernels", "tissue", "primitives", "profiles", "splines", "lining", "motion", "anatomy"),
    *("thorax", "speckle"),
)


def asked(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Compile a numeric function that Python calls to machine code, kept on disk between runs.

    The compiler looks at a function's own file alone to tell whether its stored code still holds,
    not at those of the functions it calls. So the folder is named by the sources of all.

    Calls are compiled into their callers: a call hands over every number of a heart, which costs
    more than most of these functions do.
    """
    return _compile(function, no_cpython_wrapper=False)


def inner(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """The same of a function that only compiled code calls: a way in from Python, which takes a
    heart's numbers out of their tuple, takes as long to compile as most of these functions do.
    """
    return _compile(function, no_cpython_wrapper=True)


def _compile(function: Callable[Parameters, Result], **given: bool) -> Callable[Parameters, Result]:
    options = {"cache": True, "nogil": True, "no_cfunc_wrapper": True, "forceinline": True, **given}
    usual = config.CACHE_DIR
    config.CACHE_DIR = str(Path(usual or _place()) / _digest())
    try:
        return cast("Callable[Parameters, Result]", njit(**options)(function))
    finally:
        config.CACHE_DIR = usual


@cache
def _place() -> Path:
    """Where compiled code is kept: beside the sources, else among temporary files of this run."""
    beside = Path(__file__).parent / "__pycache__"
    try:
        beside.mkdir(exist_ok=True)
        with tempfile.TemporaryFile(dir=beside):
            return beside
    except OSError:
        folder = tempfile.TemporaryDirectory(prefix="data_synth-")
        atexit.register(folder.cleanup)
        return Path(folder.name)


@cache
def _digest() -> str:
    sources = [Path(__file__).with_name(f"{name}.py").read_bytes() for name in _SOURCES]
    return "numba-" + hashlib.sha256(b"".join(sources)).hexdigest()[:12]


class Shape(NamedTuple):
    """Sizes of one heart at the R peak, in its own frame (mm, radians).

    Origin: centre of the mitral plane. z: from apex to base. x: towards the right ventricle.
    y = z cross x: towards the anterior wall.
    """

    lv_radius: float = 27.5
    """Largest radius of the left-ventricular cavity."""
    lv_length: float = 90.0
    """Apex of the cavity to the mitral plane."""
    lv_widest: float = 0.3
    """Where the cavity is widest, as a share of its length below the mitral plane."""
    lv_narrowing: float = 0.14
    """Loss of squared radius from the widest place to the mitral plane, as a share, before
    ``profiles.FLAT`` limits it: 0.14 comes to a loss of 0.107."""
    lv_wall: float = 9.0
    apex_wall: float = 5.5
    rv_width: float = 33.0
    """Largest distance from the septum to the free wall."""
    rv_half_angle: float = 1.35
    """Half of the angle that the right ventricle embraces."""
    rv_angle: float = -0.05
    """Direction of its middle, from +x towards +y."""
    rv_reach: float = 0.9
    """Its apex, as a share of the left cavity's length."""
    rv_wall: float = 3.0
    la_x: float = -10.0
    la_y: float = -10.0
    la_z: float = 21.0
    la_radius_x: float = 22.0
    la_radius_y: float = 19.5
    la_radius_z: float = 21.0
    ra_x: float = 46.0
    ra_y: float = -16.0
    ra_z: float = 20.0
    ra_radius_x: float = 22.0
    ra_radius_y: float = 22.0
    ra_radius_z: float = 25.0
    mitral_radius: float = 15.0
    tricuspid_radius: float = 16.5
    atrial_wall: float = 2.0
    vein_radius: float = 5.5
    """Pulmonary veins where they join the left atrium."""
    aorta_radius: float = 13.0
    """Ascending aorta."""
    sinus_radius: float = 15.5
    """Aortic root at its widest: the three sinuses of Valsalva."""
    appendage_length: float = 1.0
    """Scale of the finger-like appendage of the left atrium; 1 is about 50 mm along the bend."""
    appendage_radius: float = 7.0
    fat_depth: float = 1.8
    """Fat over the outer surface; the grooves hold more."""
    pericardium: float = 1.5
    papillary_radius: float = 5.0
    trabeculae: float = 4.0
    """Longest trabeculae of the left apex, mm; the right ventricle's are longer by half."""
    septal_bulge: float = 0.0
    """Thickening of the septum into the cavity, mm at its thickest place."""
    bulge_angle: float = 0.35
    """Middle of that thickening: the anterior septum."""
    scar_angle: float = 0.0
    """Middle of an infarct about the long axis, from +x towards +y."""
    scar_half_angle: float = 0.0
    """Half of the angle it takes; 0 for no infarct."""
    scar_height: float = 0.55
    """Its middle below the mitral plane, as a share of the cavity's length."""
    scar_half_height: float = 0.3
    scar_thinning: float = 0.0
    """Share of the wall's thickness lost in its middle, on the inside."""


class Tubes(NamedTuple):
    """Centre lines with radii, ``(n, 4)`` rows of x, y, z, radius in the heart frame.

    ``boxes`` holds the low and high corner of each line's tube, ``(fields, 6)``, in field order.
    """

    aorta: Float
    outflow: Float
    appendage: Float
    veins: Float
    """``(4, n, 4)``: right upper, right lower, left upper, left lower pulmonary vein."""
    pulmonary: Float
    right_branch: Float
    left_branch: Float
    upper_cava: Float
    lower_cava: Float
    anterolateral: Float
    """Papillary muscles of the left ventricle, from the wall to the tip."""
    posteromedial: Float
    moderator: Float
    """Band across the right ventricle, from the septum to the free wall."""
    right_papillary: Float
    sinuses: Float
    """``(3, 4)``: middle and radius of each sinus of Valsalva."""
    boxes: Float
