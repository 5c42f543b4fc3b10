"""Fixtures: widths, stiffness, devices, and what is refused."""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from pipeline.config import Settings, read_settings
from pipeline.errors import InputError
from pipeline.field.fixture import (
    DEFAULT_FIXTURES,
    DEVICES,
    BakeSettings,
    Fixture,
    delta_from_gamma,
    steepest_slope,
)
from pipeline.field.potential import potential
from pipeline.stages.bake import fixtures_for

GUIDANCE = {"structure": "heart", "kind": "guidance", "delta_mm": 8.0, "f_max_n": 2.0}
MINE = {"name": "virtuose", "force_n": 20, "stiffness_n_per_m": 1200}
SURFACES, LOST = ("epicardium", "lv_endocardium"), {"left_atrium": "no phase shows it"}
CONFIGS = Path(__file__).parents[1] / "configs" / "fixtures"


def fixture(**changes: object) -> Fixture:
    """A sound fixture with some keys changed; None leaves a key out."""
    merged = {**GUIDANCE, **changes}
    return Fixture.model_validate({k: v for k, v in merged.items() if v is not None})


@given(st.floats(0.1, 50), st.floats(1e-6, 1 - 1e-6), st.integers(1, 6))
def test_potential_at_gamma_is_the_level(gamma, level, m):
    delta = delta_from_gamma(gamma, level, m)

    # A few roundings, magnified by the exponent of up to 12.
    assert float(potential(gamma, delta, m)) == pytest.approx(level, rel=1e-13)


@pytest.mark.parametrize(("m", "published"), [(1, 0.607), (2, 1.077), (3, 1.584)])
def test_steepest_slope_is_the_published_one(m, published):
    assert steepest_slope(m) == pytest.approx(published, abs=5e-4)


@given(st.integers(1, 8), st.floats(0.5, 30))
def test_steepest_slope_is_the_potentials(m, delta):
    """Truth: the largest difference quotient of the formula itself."""
    q = np.linspace(0, 4 * delta, 40_001)
    quotients = np.diff(potential(q, delta, m)) / np.diff(q)

    # Mean slopes over 1e-4 delta fall short of the largest by the square of that, times curvature.
    assert quotients.max() == pytest.approx(steepest_slope(m) / delta, rel=1e-5)


def test_gamma_and_delta_describe_the_same_fixture():
    by_gamma = fixture(delta_mm=None, gamma_mm=3.0, m=2)
    by_delta = fixture(delta_mm=by_gamma.resolved_delta_mm, m=2)

    assert by_delta.resolved_gamma_mm == pytest.approx(3.0, rel=1e-14)
    assert by_delta.stiffness_n_per_m == by_gamma.stiffness_n_per_m


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"gamma_mm": 2.0}, "exactly one of delta_mm and gamma_mm, got both"),
        ({"delta_mm": None}, "exactly one of delta_mm and gamma_mm, got neither"),
        ({"gamma_level": 0.05}, "gamma_level belongs to gamma_mm"),
        ({"kind": "forbidden_region"}, "needs side: inside or outside"),
        ({"side": "inside"}, "side belongs to a forbidden_region"),
        ({"f_max_n": 3.4}, r"3.4 N is beyond the touch, which exerts 3.3 N"),
        ({"f_max_n": 9.0, "device": "falcon"}, "beyond the falcon"),
        ({"f_max_n": 0}, "greater than 0"),
        ({"m": 0}, "greater than or equal to 1"),
        ({"m": 1.5}, "valid integer"),
        ({"delta_mm": float("nan")}, "finite number"),
        ({"device": "hammer"}, "none of touch, falcon, omega7; describe one of your own"),
        ({"device": {"name": "touch", "force_n": 9, "stiffness_n_per_m": None}}, "touch is known"),
        ({"device": {"name": "mine", "force_n": 9}}, "device.stiffness_n_per_m"),
        ({"device": MINE, "f_max_n": 20.5}, "20.5 N is beyond the virtuose, which exerts 20 N"),
        ({"device": MINE, "f_max_n": 16}, "stiffer than the virtuose can render.*most 1200 N/m"),
        ({"kind": "push"}, "'guidance' or 'forbidden_region'"),
        ({"stifness": 3}, "Extra inputs are not permitted"),
    ],
)
def test_wrong_fixtures_are_refused(changes, words):
    with pytest.raises(ValidationError, match=words):
        fixture(**changes)


def gamma_of(delta_mm: float, m: int) -> float:
    """The distance at which a potential of this width is 0.01: the law, solved for it."""
    return delta_mm * math.sqrt(2) * (-math.log(0.99)) ** (1 / (2 * m))


@given(
    st.floats(1.0, 3.3),
    st.integers(1, 5),
    st.sampled_from(["delta_mm", "gamma_mm"]),
    st.sampled_from(["touch", "omega7"]),
)
def test_too_stiff_names_the_smallest_width_that_would_do(force, m, key, device):
    others = {"delta_mm": None, "f_max_n": force, "m": m, "device": device}
    with pytest.raises(ValidationError, match="stiffer than") as refusal:
        fixture(**{**others, key: 0.1 if key == "delta_mm" else gamma_of(0.1, m)})
    named = float(str(refusal.value).split(f"{key} = ")[1].split()[0].rstrip(","))

    allowed = fixture(**{**others, key: named})

    assert allowed.stiffness_n_per_m <= DEVICES[device].stiffness_n_per_m * (1 + 1e-9)
    # Named to a thousandth of a millimetre, rounded up: 0.002 less is too little.
    with pytest.raises(ValidationError, match="stiffer than"):
        fixture(**{**others, key: named - 0.002})


def test_the_falcon_has_no_known_stiffness_limit():
    assert fixture(device="falcon", delta_mm=0.1).stiffness_n_per_m > 1e4


@pytest.mark.parametrize(
    "changes",
    [
        {"delta_mm": 1e-170, "device": "falcon"},
        {"delta_mm": 0.01, "device": "falcon"},
        {"delta_mm": 0.09, "device": "falcon"},
        {"delta_mm": 1e308},
        {"delta_mm": None, "gamma_mm": 5e-324},
        {"delta_mm": None, "gamma_mm": 1e-3, "m": 20, "device": "falcon"},
        {"delta_mm": None, "gamma_mm": 900.0},
        {"delta_mm": None, "gamma_mm": 2.0, "gamma_level": 1e-300},
        {"f_max_n": 5e-324},
        {"f_max_n": 1e300, "device": {"name": "m", "force_n": 1e308, "stiffness_n_per_m": None}},
    ],
)
def test_widths_and_forces_of_no_hand_and_no_heart_are_refused(changes):
    asked = {key: value for key, value in {**GUIDANCE, **changes}.items() if value is not None}
    with pytest.raises(ValidationError, match=r"needs 0\.\d+ to 1000|is no width"):
        Settings.model_validate({"fixtures": {"one": asked}})


def test_a_store_may_hold_what_settings_refuse():
    """It was baked by rules of before, and is as whole as ever."""
    assert fixture(device="falcon", delta_mm=0.05).stiffness_n_per_m > 1e4


def test_settings_do_not_change_and_know_their_keys():
    with pytest.raises(ValidationError, match="frozen"):
        fixture().f_max_n = 1.0
    with pytest.raises(ValidationError, match="Extra inputs"):
        BakeSettings.model_validate({"spacing": 1})
    with pytest.raises(ValidationError, match="greater than or equal to 15"):
        BakeSettings(margin_mm=10)


def test_default_fixtures_are_those_of_the_files():
    """The files show the defaults; a Touch can render each, or they would not load."""
    found: dict[str, object] = {}
    for path in CONFIGS.glob("*.yaml"):
        found |= yaml.safe_load(path.read_text())["fixtures"]

    assert {name: Fixture.model_validate(one) for name, one in found.items()} == DEFAULT_FIXTURES
    assert {one.device.name for one in DEFAULT_FIXTURES.values()} == {"touch"}


def test_settings_written_down_are_read_back():
    """A known device by its name alone, one's own as it was described."""
    for one in (fixture(), fixture(device="omega7"), fixture(device=MINE, f_max_n=10)):
        assert Fixture.model_validate(one.model_dump(exclude_unset=True)) == one
    assert fixture(device="omega7").model_dump()["device"] == "omega7"


def test_settings_load_without_numpy():
    code = (
        "import sys, pipeline.field.fixture\n"
        "heavy = {'numpy', 'numba', 'zarr', 'scipy'} & set(sys.modules)\n"
        "sys.exit(f'loaded {heavy}' if heavy else 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


class TestFixturesOfAStudyWithoutAnAtrium:
    """A stack that ends at the valves: which fixtures are baked, and which are missed."""

    def test_the_defaults_are_baked_but_that_on_the_atrium(self):
        kept, missing = fixtures_for(Settings(), SURFACES, LOST)
        assert list(kept) == ["epicardium_guidance", "left_ventricle_forbidden"]
        assert missing == {"left_atrium_guidance": "needs left_atrium, which has no surface"}

    def test_defaults_written_down_are_defaults(self):
        """As one who copies configs/default.yaml has them."""
        written = read_settings(Path(__file__).parents[1] / "configs" / "default.yaml")
        assert "fixtures" in written.model_fields_set
        assert fixtures_for(written, SURFACES, LOST) == fixtures_for(Settings(), SURFACES, LOST)

    @pytest.mark.parametrize(
        ("settings", "who"),
        [
            ({"fixtures": {"mine": GUIDANCE | {"structure": "left_atrium"}}}, "fixture mine"),
            ({"bake": {"structures": ["left_atrium"]}}, "bake.structures left_atrium"),
        ],
    )
    def test_what_a_user_asks_for_is_missed_and_the_cause_told(self, settings, who):
        words = f"{who} needs left_atrium, which has no surface: no phase shows it; take it out"
        with pytest.raises(InputError, match=words):
            fixtures_for(Settings.model_validate(settings), SURFACES, LOST)


def test_known_devices_render_what_their_makers_say():
    known = {name: (one.force_n, one.stiffness_n_per_m) for name, one in DEVICES.items()}
    assert known == {"touch": (3.3, 400), "falcon": (8.9, None), "omega7": (12, 5000)}
