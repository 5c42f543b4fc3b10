"""The offset between clocks: agreement curves whose summit is known."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.errors import InputError
from pipeline.registration.clock_offset import estimate_offset

OFFSETS_S = np.arange(-15, 16) * 0.02
RR_S = 0.8


def study(seed, true_s=0.04, noise=0.1, beats=40, per_beat=15):
    """Frames whose agreement falls as a cosine of the beat, with an error common to each beat."""
    rng = np.random.default_rng(seed)
    times_s = np.arange(beats * per_beat) * RR_S / per_beat + 0.01
    r_times_s = np.arange(beats + 1) * RR_S
    own_s = true_s + 0.02 * np.repeat(rng.normal(size=beats), per_beat)
    clean = np.cos(2 * np.pi * (OFFSETS_S[:, None] - own_s) / RR_S)
    return times_s, r_times_s, clean + noise * rng.normal(size=clean.shape)


def test_the_offset_and_its_error_are_those_drawn():
    found = [
        estimate_offset(OFFSETS_S, scores, times_s, r_times_s)
        for times_s, r_times_s, scores in (study(seed) for seed in range(60))
    ]
    error_s = np.array([one.offset_s for one in found]) - 0.04
    z = error_s / np.array([one.sd_s for one in found])
    assert np.quantile(np.abs(error_s), 0.95) < 0.010
    # The root mean square of 60 standard normal values is 1 within 0.09; four of those, and the
    # same again for the resampling's own scatter.
    assert 0.6 < np.sqrt((z**2).mean()) < 1.4


def test_frames_that_tell_nothing_give_no_offset():
    rng = np.random.default_rng(0)
    times_s, r_times_s, scores = study(0)
    found = estimate_offset(OFFSETS_S, rng.normal(size=scores.shape), times_s, r_times_s)
    assert found.offset_s is None


def test_a_summit_outside_the_offsets_tried_is_none():
    times_s, r_times_s, scores = study(0, true_s=0.34)
    assert estimate_offset(OFFSETS_S, scores, times_s, r_times_s).offset_s is None


def test_too_few_beats_give_no_offset():
    times_s, r_times_s, scores = study(0, beats=5)
    assert estimate_offset(OFFSETS_S, scores, times_s, r_times_s).offset_s is None


def test_frames_without_a_score_do_not_count():
    times_s, r_times_s, scores = study(1)
    kept = estimate_offset(OFFSETS_S, scores[:, 30:], times_s[30:], r_times_s)
    scores[:, :30] = np.nan
    assert estimate_offset(OFFSETS_S, scores, times_s, r_times_s) == kept


@pytest.mark.parametrize("offsets_s", [OFFSETS_S[:5], OFFSETS_S[::-1], OFFSETS_S**3])
def test_uneven_offsets_are_refused(offsets_s):
    times_s, r_times_s, scores = study(0)
    with pytest.raises(InputError, match="evenly spaced"):
        estimate_offset(offsets_s, scores[: len(offsets_s)], times_s, r_times_s)


def test_scores_of_another_shape_are_refused():
    times_s, r_times_s, scores = study(0)
    with pytest.raises(InputError, match="scores of shape"):
        estimate_offset(OFFSETS_S, scores.T, times_s, r_times_s)
