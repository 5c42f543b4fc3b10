"""Pictures that the network for ultrasound is trained on."""

from __future__ import annotations

import numpy as np
import pytest

from data_synth.echo import ECHOES
from data_synth.errors import SynthError
from data_synth.tissue import Tissue
from data_synth.training.ultrasound import pictures
from data_synth.training.ultrasound.pictures import (
    BLOOD,
    CLASS_OF_TISSUE,
    CLASSES,
    OUTSIDE,
    WALL,
    Picture,
    draw_echoes,
    fill_pool,
    heart_pictures,
    read_pool,
)


@pytest.fixture(scope="module")
def drawn():
    return heart_pictures(9100, 8)


def test_pictures_repeat_and_do_not_depend_on_their_number(drawn):
    for one, other in zip(drawn, heart_pictures(9100, 4), strict=False):
        np.testing.assert_array_equal(one.grey, other.grey)
        np.testing.assert_array_equal(one.label, other.label)


def test_labels_fill_the_sector_and_tell_what_grey_values_show(drawn):
    assert len(drawn) == 8
    for picture in drawn:
        inside = picture.label != OUTSIDE
        assert picture.label[inside].max() < CLASSES
        assert 0.2 < inside.mean() < 0.9
    # Over all pictures blood is darker than walls: sound meets less in it.
    grey, label = (
        np.concatenate([getattr(one, name).ravel() for one in drawn]) for name in ("grey", "label")
    )
    assert grey[label == BLOOD].mean() < grey[label == WALL].mean()


def test_what_grows_into_a_cavity_is_blood_as_to_the_surfaces():
    for tissue in (Tissue.PAPILLARY_MUSCLE, Tissue.RV_TRABECULA, Tissue.LEAFLET, Tissue.AORTA):
        assert CLASS_OF_TISSUE[tissue] == BLOOD
    assert CLASS_OF_TISSUE[Tissue.SCAR] == CLASS_OF_TISSUE[Tissue.LV_MYOCARDIUM] == WALL


def test_muscle_stays_brighter_than_blood_whatever_is_drawn():
    usual = ECHOES.scatter.copy()
    levels = [draw_echoes(np.random.default_rng(seed)).scatter for seed in range(200)]
    for scatter in levels:
        # 14 dB is the least between their means. Muscle as a whole, this one and blood are drawn
        # with deviations of 1, 1.5 and 1 dB, 2.06 together: five of them leave 3.7.
        assert scatter[Tissue.LV_MYOCARDIUM] > 10 ** (3.7 / 20) * scatter[Tissue.LV_CAVITY]
    assert np.std([scatter[Tissue.FAT] for scatter in levels]) > 0.1
    np.testing.assert_array_equal(ECHOES.scatter, usual)


def test_pool_is_filled_once_and_kept(tmp_path, monkeypatch):
    made = []

    def quick(number, frames):
        made.append(number)
        return [Picture(np.full((3, 4 + k), number, np.uint8), np.full((3, 4 + k), 1, np.uint8))
                for k in range(frames)]  # fmt: skip

    monkeypatch.setattr(pictures, "heart_pictures", quick)
    told = []
    first = fill_pool(tmp_path, 2, 12)
    paths = fill_pool(tmp_path, 3, 12, lambda *done: told.append(done))
    assert made == [0, 1, 2]
    assert paths[:2] == first
    assert told == [(3, 3)]
    kept = read_pool(paths)
    assert len(kept) == 36
    assert [one.grey.shape[1] for one in kept[:12]] == list(range(4, 16))
    with pytest.raises(SynthError, match=r"drawn with .*12.*, not .*60"):
        fill_pool(tmp_path, 3, 60)
