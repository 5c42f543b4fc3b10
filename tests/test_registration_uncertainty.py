"""Covariance, expected error and verdict, against statistics and geometry worked out apart."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi

from pipeline.errors import StageError
from pipeline.geometry import transform_points
from pipeline.registration import space
from pipeline.registration.clock_offset import ClocksApart
from pipeline.registration.dissent import NONE, longest_astray, outvoted
from pipeline.registration.parts import Apart
from pipeline.registration.pose_search import Pivot
from pipeline.registration.settings import RegisterSettings
from pipeline.registration.size import AS_IT_IS, Size
from pipeline.registration.uncertainty import (
    Curvature,
    chance_below,
    curvature_at,
    expected_tre_mm,
    floor_of,
    in_radians,
    long_run,
    rising,
    sandwich,
    slopes_at,
)
from pipeline.registration.verdict import Evidence, judge

PIVOT = Pivot(np.array([10.0, -20.0, 30.0]), 40.0)
BENDING = np.diag([2.0, 3.0, 1.0, 1.5, 0.5, 4.0]) + 0.2
SOUND = {
    "confidence": 4.0,
    "rival": 0.4,
    "expected_mm": 0.9,
    "valid": 40,
    "frames": 48,
    "shift_mm": 9.0,
    "turn_deg": 8.0,
}


def quadratic_losses(optima):
    """Each frame's loss: half the squared distance from its own optimum, in BENDING's metric."""

    def losses(step):
        off = step - optima
        return 0.5 * np.einsum("fi,ij,fj->f", off, BENDING, off)

    return losses


def test_derivatives_of_a_quadratic_are_exact():
    """Central differences of second order are exact for polynomials of degree 2."""
    optima = np.random.default_rng(0).normal(size=(9, 6))
    found = curvature_at(quadratic_losses(optima))
    np.testing.assert_allclose(found.bending, 9 * BENDING, rtol=1e-9)
    np.testing.assert_allclose(found.slopes, -optima @ BENDING, rtol=1e-9, atol=1e-9)
    slopes = slopes_at(quadratic_losses(optima))
    np.testing.assert_allclose(slopes, -optima @ BENDING, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("persistence", [0.0, 0.6])
def test_covariance_is_that_of_repeated_estimates(persistence):
    """Frames' optima follow an autoregression; their mean, repeated, has a known spread.

    The sum of 200 frames of lag-1 correlation r has (1 + r) / (1 - r) times the variance of
    independent ones. With Bartlett's weights over 20 lags one estimate is short by r / (1 - r^2)
    * 2 / 21 (9 % at r = 0.6) and by the removed mean's 21 / 200 = 10 %, and 200 / 194 too large:
    at most 17 % short. The mean over 300 repeats and 6 parameters has a sampling error of
    sqrt(4 / 3 * 20 / 200 / 1800) = 1 %.
    """
    rng = np.random.default_rng(1)
    estimates = []
    for _ in range(300):
        noise = rng.normal(size=(200, 6))
        optima = np.empty_like(noise)
        optima[0] = noise[0]
        for k in range(1, 200):
            fresh = np.sqrt(1 - persistence**2) * noise[k]
            optima[k] = persistence * optima[k - 1] + fresh
        at = quadratic_losses(optima - optima.mean(axis=0))
        estimates.append(np.diag(sandwich(curvature_at(at), np.zeros(200, int), reach=0.1)))
    truth = (1 + persistence) / (1 - persistence) / 200
    assert np.mean(estimates) == pytest.approx(truth, rel=0.2)


def test_frames_of_different_sweeps_are_not_neighbours():
    optima = np.repeat([[1.0] * 6, [-1.0] * 6], 8, axis=0)
    at = curvature_at(quadratic_losses(optima))
    together = sandwich(at, np.zeros(16, int))
    apart = sandwich(at, np.repeat([0, 1], 8))
    assert not np.allclose(together, apart)
    np.testing.assert_allclose(sandwich(at, np.repeat([5, 9], 8)), apart)


def test_a_direction_that_no_frame_fixes_is_left_open():
    """Losses that do not change along x: the spread there is metres, elsewhere it is not."""
    rng = np.random.default_rng(2)
    optima = rng.normal(size=(30, 6))

    def losses(step):
        off = (step - optima)[:, 1:]
        return 0.5 * (off**2).sum(axis=1) + 1e-3 * optima[:, 0] * step[0]

    spread = np.sqrt(np.diag(sandwich(curvature_at(losses), np.zeros(30, int))))
    assert spread[0] > 10
    assert spread[1:].max() < 1


def test_a_direction_in_which_losses_fall_is_left_open():
    slopes = np.random.default_rng(2).normal(size=(30, 6))
    bending = np.diag([-30.0] + [30.0] * 5)
    spread = np.sqrt(np.diag(sandwich(Curvature(slopes, bending), np.zeros(30, int))))
    assert spread[0] > 10
    assert spread[1:].max() < 1


@pytest.mark.parametrize(
    ("sizes", "reach", "lags"),
    [((12,), 0.25, (3,)), ((12, 4), 0.25, (3, 1)), ((3, 2), 0.1, (1, 1)), ((5, 1), 1.0, (4, 0))],
)
def test_neighbours_weigh_as_in_the_squares_of_running_sums(sizes, reach, lags):
    """With Bartlett's weights over m lags the covariance is the mean of m + 1 products of sums over
    m + 1 frames, at all places where these overlap the sweep (Newey and West's proof that it is
    none below zero). At least the next frame counts, however few there are."""
    rng = np.random.default_rng(5)
    own = [rng.normal(size=(size, 3)) for size in sizes]
    expected = np.zeros((3, 3))
    for slopes, count in zip(own, lags, strict=True):
        window = np.ones(count + 1)
        sums = np.stack([np.convolve(column, window) for column in slopes.T])
        expected += sums @ sums.T / (count + 1)
    found = long_run(np.concatenate(own), np.repeat(np.arange(len(sizes)), sizes), reach)
    np.testing.assert_allclose(found, expected, atol=1e-12)


@given(st.integers(0, 10_000))
def test_expected_error_is_that_of_drawn_poses(seed):
    """4000 poses drawn from a small covariance: the mean square differs by its own sampling.

    The mean of 4000 squares of a normal 3-vector has a relative error under sqrt(2 / 4000) = 2.2 %,
    its root half of that: 6 % is more than five of those. Rotations stay under 0.04 rad, where the
    second order changes a displacement by 2 % at most.
    """
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(6, 6)) * np.repeat([0.3, 0.004], 3)[:, None]
    covariance = factor @ factor.T
    point = PIVOT.centre_mm + rng.uniform(-60, 60, 3)
    steps = rng.multivariate_normal(np.zeros(6), covariance, 4000)
    moved = Rotation.from_rotvec(steps[:, 3:]).apply(point - PIVOT.centre_mm) + PIVOT.centre_mm
    drawn = np.sqrt(((moved + steps[:, :3] - point) ** 2).sum(axis=1).mean())
    expected = expected_tre_mm(covariance, PIVOT.centre_mm, point[None])[0]
    assert expected == pytest.approx(drawn, rel=0.08)


class TestChance:
    """Counts of 4,000 draws have a standard deviation of 0.008 at most: within four of it."""

    @pytest.mark.parametrize(("sd_mm", "limit_mm"), [(0.5, 1.0), (1.0, 2.0), (1.0, 1.0)])
    def test_shifts_alike_in_all_directions_have_a_chi_of_three(self, sd_mm, limit_mm):
        covariance = np.diag([sd_mm**2] * 3 + [0.0] * 3)
        points_mm = np.random.default_rng(0).normal(0, 40, (5, 3))
        found = chance_below(covariance, PIVOT.centre_mm, points_mm, limit_mm)
        assert found == pytest.approx(chi(3).cdf(limit_mm / sd_mm), abs=0.032)

    def test_turns_about_two_axes_move_a_point_on_the_third_by_a_chi_of_two(self):
        covariance = np.diag([0.0, 0, 0, 0.02**2, 0.02**2, 1.0])
        on_axis_mm = PIVOT.centre_mm + np.array([[0, 0, 50.0]])
        found = chance_below(covariance, PIVOT.centre_mm, on_axis_mm, 1.5)
        assert found == pytest.approx(chi(2).cdf(1.5 / (0.02 * 50)), abs=0.032)

    def test_it_is_the_mean_over_the_points_that_counts(self):
        """A turn moves the points at its axis by nothing and one far away by the more."""
        covariance = np.diag([0.0, 0, 0, 0, 0, 0.05**2])
        points_mm = PIVOT.centre_mm + np.array([[0, 0, 9.0], [60.0, 0, 0]])
        found = chance_below(covariance, PIVOT.centre_mm, points_mm, 2.0)
        # Mean 30 |turn| mm below 2: |turn| < 4 / 60.
        assert found == pytest.approx(chi(1).cdf(4 / 60 / 0.05), abs=0.032)


def test_floor_alone_gives_its_own_error_at_the_centre_and_at_the_lever():
    """sqrt(3) e at the centre; one lever away two rotations add to it: sqrt(5) e."""
    floor = floor_of(0.5, 7.0 * np.eye(6), PIVOT)
    points = PIVOT.centre_mm + np.array([[0, 0, 0], [PIVOT.lever_mm, 0, 0]])
    expected = expected_tre_mm(floor, PIVOT.centre_mm, points)
    np.testing.assert_allclose(expected, 0.5 * np.sqrt([3, 5]))


def test_floor_reaches_further_where_the_frames_hold_the_pose_less():
    """A direction of a quarter of the mean curvature: twice the error; of all directions together
    the curvature says nothing, so its unit does not count."""
    bending = np.diag([1.0, 1.0, 1.0, 1.0, 0.25, 1.75])
    floor = in_millimetres(floor_of(0.5, bending, PIVOT))
    np.testing.assert_allclose(floor, in_millimetres(floor_of(0.5, 9 * bending, PIVOT)))
    np.testing.assert_allclose(np.sqrt(np.diag(floor))[:5], [0.5, 0.5, 0.5, 0.5, 1.0])


def in_millimetres(covariance):
    """Covariance of shift and rotation vector as that of arcs at the pivot's lever."""
    scale = np.repeat([1.0, PIVOT.lever_mm], 3)
    return covariance * np.outer(scale, scale)


def test_step_between_poses_is_the_one_that_was_made():
    step = np.array([1.0, -2.0, 0.5, 3.0, 1.0, -2.0])
    pose = np.eye(4)
    pose[:3, 3] = 5, 6, 7
    np.testing.assert_allclose(PIVOT.step_between(pose, PIVOT.move(pose, step)), step, atol=1e-12)
    there = transform_points(PIVOT.move(np.eye(4), step), PIVOT.centre_mm)
    np.testing.assert_allclose(there - PIVOT.centre_mm, step[:3], atol=1e-12)


def test_covariance_in_radians_is_divided_by_the_lever():
    scaled = in_radians(np.eye(6), PIVOT)
    np.testing.assert_allclose(np.diag(scaled), [1, 1, 1, *[1 / 1600] * 3])


class TestVerdict:
    def test_sound_evidence_is_good(self):
        assert judge(Evidence(**SOUND), RegisterSettings()).grade == "good"

    @pytest.mark.parametrize(
        "change",
        [
            {"shift_mm": 29.0},
            {"turn_deg": 29.0},
            {"rival": 0.75},
            # A quarter more than is needed.
            {"confidence": 2.0},
            # Three frames in four.
            {"valid": 36},
            # Parts of right studies agreed better with poses of their own by 0.042 at most.
            {"apart": 0.045},
        ],
    )
    def test_what_lies_within_the_limits_is_good(self, change):
        """The search takes starts of 20 mm and 20 degrees, and an optimum may lie beyond."""
        assert judge(Evidence(**(SOUND | change)), RegisterSettings()).grade == "good"

    def test_who_asks_for_less_confidence_has_no_failure_without_a_reason(self):
        settings = RegisterSettings(min_confidence=0.5)
        assert judge(Evidence(**(SOUND | {"confidence": 0.9})), settings).grade == "good"

    def test_a_size_is_named_as_the_cause_of_a_failure_but_where_frames_fit_better_elsewhere(self):
        wrong = SOUND | {"expected_mm": 9.0, "size": Size(0.08, 0.1)}
        for confidence, named in ((1.7, True), (1.1, True), (0.9, False)):
            said = judge(Evidence(**(wrong | {"confidence": confidence})), RegisterSettings())
            assert said.grade == "failed"
            assert ("8% larger" in said.reason) == named

    @pytest.mark.parametrize(
        ("change", "reason"),
        [
            ({"expected_mm": 2.0}, "expected error 2.0 mm"),
            ({"confidence": 1.7}, "1.70 times"),
            ({"confidence": 1.95}, "1.95 times"),
            ({"rival": 0.76}, "to 76%"),
            ({"rival": 0.9}, "to 90%"),
            ({"valid": 35}, "35 of 48 frames that show the heart"),
            ({"valid": 24}, "24 of 48 frames that show the heart"),
            ({"outvoted": (2,)}, "few frames of sweep 2 bear out"),
            ({"outvoted": (2,), "elsewhere_mm": 5.2}, "and agree on a place 5 mm away"),
            ({"inspired": True}, "the heart is taken to rest"),
            (
                {"clocks": ClocksApart(ahead=2, behind=1, by_s=0.15)},
                "time stamps of sweep 2 are 0.15 s ahead of those of sweep 1 by",
            ),
            ({"size": Size(-0.08, 0.1)}, "agree 10% better with a heart 8% smaller than"),
            ({"apart": 0.07}, "parts of the recording agree 7% better with poses of their own"),
        ],
    )
    def test_each_weakness_makes_it_doubtful_and_is_named(self, change, reason):
        verdict = judge(Evidence(**(SOUND | change)), RegisterSettings())
        assert verdict.grade == "doubtful"
        assert reason in verdict.reason

    @pytest.mark.parametrize(
        ("change", "reason"),
        [
            ({"expected_mm": 9.0}, "leave the pose open"),
            ({"expected_mm": float("nan")}, "leave the pose open"),
            ({"expected_mm": 9.0, "size": Size(0.08, 0.1)}, "better with a heart 8% larger"),
            ({"expected_mm": 9.0, "apart": 0.4}, "is the calibration or the pixel size off"),
            ({"confidence": 1.1}, "no pose to trust"),
            (
                {"confidence": 0.5, "misplaced": "mirrored"},
                "; mirrored they agree 2.0 times better",
            ),
            # Frames that agree with nothing where they came.
            ({"confidence": 0.0, "misplaced": "mirrored"}, "; mirrored they agree"),
            ({"rival": 0.91}, "two poses far apart"),
            ({"valid": 3}, "only 3 of 48"),
            ({"valid": 23}, "only 23 of 48 frames that show the heart bear the registration out"),
            ({"expected_mm": 9.0, "astray": (12, 1)}, "12 frames in a row of sweep 1"),
            ({"shift_mm": 31.0}, "31.0 mm"),
            ({"turn_deg": 31.0}, "31.0 degrees"),
        ],
    )
    def test_each_fault_fails_it_and_is_named(self, change, reason):
        verdict = judge(Evidence(**(SOUND | change)), RegisterSettings())
        assert verdict.grade == "failed"
        assert reason in verdict.reason

    @pytest.mark.parametrize(
        ("borne_out", "named"),
        [
            ((20, 0), (2,)),
            ((20, 5), (2,)),
            ((20, 6), ()),
            ((9, 0), ()),
            ((10, 0), (2,)),
            ((20, 20), ()),
        ],
    )
    def test_a_sweep_that_contradicts_the_other_is_outvoted(self, borne_out, named):
        """As one whose calibration is another's: both cannot be right, and a pose says nothing."""
        sweep = np.repeat([0, 1, 2], [20, 20, 4])
        bears_out = np.concatenate([np.arange(20) < count for count in borne_out] + [np.zeros(4)])
        assert outvoted(sweep, bears_out.astype(bool), least=10) == named

    def test_sweeps_of_a_registration_are_compared(self):
        borne_out = np.arange(40) < 20
        one, two = np.zeros(40, int), np.repeat([0, 1], 20)
        same = Apart(0.0, np.zeros((6, 6)))
        alone = {"dissent": NONE, "breath_mm": np.zeros(40)}
        sure = {"confidence": 2.0, "rival": 0.1, "size": AS_IT_IS, "apart": same, "misplaced": ""}
        search = SimpleNamespace(settings=RegisterSettings(), start=None, pivot=None)

        def judged(sweep, shows):
            level = SimpleNamespace(samples=SimpleNamespace(sweep=sweep))
            aside = outvoted(sweep, shows, least=10)
            seen = {"shows": shows, "aside": aside, "bears_out": borne_out, "clocks": None}
            found = SimpleNamespace(level=level, pose=None, **seen, **sure, **alone)
            return space._verdict(found, search, 1.0)

        verdict = judged(two, np.ones(40, bool))
        assert verdict.grade == "doubtful"
        assert "frames of sweep 2 bear out" in verdict.reason
        verdict = judged(one, np.ones(40, bool))
        assert verdict.grade == "doubtful"
        assert "20 frames in a row of sweep 1" in verdict.reason
        # A sweep that leaves the heart speaks for itself; one that hardly meets it, for a tracker
        # that was moved between them, or for poses in another unit.
        assert judged(one, borne_out).grade == "good"
        verdict = judged(two, borne_out)
        assert verdict.grade == "doubtful"
        assert "few frames of sweep 2 show the heart" in verdict.reason
        verdict = judged(two, np.arange(40) < 26)
        assert "few frames of sweep 2 show the heart" not in verdict.reason

    def test_frames_of_a_sweep_beside_the_heart_tell_no_clock(self):
        """They have no time of their own."""
        samples = SimpleNamespace(sweep=np.repeat([0, 1], 20))
        level = SimpleNamespace(samples=samples, only=list)
        assert space._of_sweeps_of_the_heart(level, (2,)) == list(range(20))
        assert space._of_sweeps_of_the_heart(level, ()) == list(range(40))

    def test_frames_that_agree_best_as_they_came_are_not_said_to_agree_better_otherwise(self):
        weak = SOUND | {"confidence": 1.1, "shift_mm": 31.0, "misplaced": "mirrored"}
        said = judge(Evidence(**weak), RegisterSettings())
        assert said.grade == "failed"
        assert "mirrored" not in said.reason
        assert "give a better start" in said.reason

    def test_settings_refuse_bounds_that_cross(self):
        with pytest.raises(ValueError, match="raise worst_tre_mm or lower good_tre_mm"):
            RegisterSettings(good_tre_mm=3, worst_tre_mm=2)
        with pytest.raises(ValueError, match=r"(?s)seed.*greater than or equal to 0"):
            RegisterSettings(seed=-1)


@pytest.mark.parametrize("verdict", ["good", "doubtful", "failed"])
def test_doubts_are_told_before_other_reasons_and_mend_no_failure(monkeypatch, verdict):
    reason = "" if verdict == "good" else "far"
    found = space._doubted(Result(verdict, reason), ["mirrored"])
    reasons = "; ".join(filter(None, ["mirrored", reason]))
    assert found == Result("failed" if verdict == "failed" else "doubtful", reasons)
    assert space._doubted(Result(verdict, reason), []) == Result(verdict, reason)
    monkeypatch.setattr(space, "find", lambda *_: found)
    if verdict == "failed":
        with pytest.raises(StageError, match=r"^mirrored; far$"):
            space.register([], [], {}, None, doubts=["mirrored"])
        return
    assert space.register([], [], {}, None, doubts=["mirrored"]) == found


@dataclass
class Result:
    """What `register` looks at of a registration."""

    verdict: str
    reason: str


def test_a_turn_that_the_shift_undoes_at_a_point_leaves_it_in_its_place():
    """Shift and turn err together: about the point itself, which stays, not about the centre."""
    way = 0.05 * np.array([0, -60.0, 0, 0, 0, 1])
    points_mm = PIVOT.centre_mm + np.array([[60.0, 0, 0]])
    assert chance_below(np.outer(way, way), PIVOT.centre_mm, points_mm, 1e-3) == 1
    # Rounding takes some of such squares below zero.
    for turn in np.linspace(0.01, 0.1, 20):
        still = turn * np.array([0, -60.0, 0, 0, 0, 1])
        assert expected_tre_mm(np.outer(still, still), PIVOT.centre_mm, points_mm) < 1e-6


def test_nine_frames_that_bear_it_out_are_one_too_few():
    few = SOUND | {"frames": 10}
    assert judge(Evidence(**(few | {"valid": 9})), RegisterSettings()).grade == "failed"
    assert judge(Evidence(**(few | {"valid": 10})), RegisterSettings()).grade == "good"


def test_frames_that_are_truly_misplaced_need_no_better_start():
    wrong = SOUND | {"confidence": 0.1, "shift_mm": 31.0}
    said = judge(Evidence(**wrong), RegisterSettings()).reason
    assert "give a better start" in said
    said = judge(Evidence(**wrong, misplaced="mirrored"), RegisterSettings(min_confidence=0.05))
    assert said.grade == "failed"
    assert "give a better start" not in said.reason
    assert "ended 31.0 mm" in said.reason


def test_six_fitted_parameters_are_taken_off_the_frames():
    slopes = np.concatenate([np.eye(6), -np.eye(6)])
    # Frames of sweeps of their own: slopes' squares add up to 2, and 12 frames leave 6 free.
    found = sandwich(Curvature(slopes, np.eye(6)), np.arange(12))
    np.testing.assert_allclose(found, 4 * np.eye(6))
    # No fewer than one is free, though six frames or fewer are all fitted.
    found = sandwich(Curvature(slopes[[0, 6]], np.eye(6)), np.arange(2))
    np.testing.assert_allclose(found, np.diag([4.0] + [0.0] * 5))


@pytest.mark.parametrize(
    ("fits", "expected"),
    [
        ("1111|1111", (0, 0)),
        ("1011|1001", (2, 2)),
        # A run ends where its sweep does.
        ("1100|0011", (2, 2)),
        ("0001|1000", (3, 2)),
        ("0000|1111", (4, 1)),
    ],
)
def test_frames_in_a_row_that_go_astray_are_counted_within_a_sweep(fits, expected):
    one, two = fits.split("|")
    sweep = np.repeat([0, 1], [len(one), len(two)])
    assert longest_astray(sweep, np.array([part == "1" for part in one + two])) == expected


def test_ten_frames_in_a_row_that_go_astray_put_a_result_in_doubt():
    assert judge(Evidence(**(SOUND | {"astray": (9, 2)})), RegisterSettings()).grade == "good"
    said = judge(Evidence(**(SOUND | {"astray": (10, 2)})), RegisterSettings(min_frames=20))
    assert said.grade == "doubtful"
    assert "10 frames in a row of sweep 2 show the heart" in said.reason


def test_what_bends_downwards_is_taken_out_and_the_rest_is_as_it_was():
    axes = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()
    found = rising(axes @ np.diag([3.0, 1.0, -2.0]) @ axes.T)
    np.testing.assert_allclose(found, axes @ np.diag([3.0, 1.0, 0.0]) @ axes.T, atol=1e-12)


def test_a_slope_that_all_frames_share_is_no_spread_between_them():
    slopes = np.random.default_rng(3).normal(size=(40, 6))
    apart, shared = (
        sandwich(Curvature(slopes + both, BENDING), np.repeat([0, 1], 20))
        for both in (np.zeros(6), np.array([0.7, -0.4, 0.0, 2.0, 0.1, -3.0]))
    )
    np.testing.assert_allclose(apart, shared, rtol=1e-9, atol=1e-12)
