"""Machine code that is kept between runs is that of the sources as they are."""

from pathlib import Path

import pytest

from data_synth import kernels as phantom
from pipeline.compiled import kept_with
from pipeline.evaluation import compiled as dissection
from pipeline.field import kernels as field
from pipeline.registration import compiled as clock


@pytest.mark.parametrize(
    ("door", "marks"),
    [
        (phantom, ("compiled",)),
        (clock, ("compiled",)),
        (field, ("asked", "inner")),
        (dissection, ("asked", "inner")),
    ],
    ids=["phantom", "clock", "field", "dissection"],
)
def test_every_compiled_source_tells_stored_code_apart(door, marks):
    folder = Path(door.__file__).parent
    using = {
        path.stem
        for path in folder.glob("*.py")
        if any(f"\n@{start}{mark}\n" in path.read_text() for mark in marks for start in ("", "_"))
    }
    assert len(using) > 1
    assert using <= set(door._SOURCES)
    assert all((folder / f"{name}.py").is_file() for name in door._SOURCES)


def test_what_compiled_code_takes_from_elsewhere_tells_it_apart_too():
    assert "tissue" in phantom._SOURCES
    assert "detector_state" in clock._SOURCES
    assert "potential" in field._SOURCES
    assert {"operators", *(f"../field/{name}" for name in ("potential", "kernels"))} <= {
        *dissection._SOURCES
    }


def test_a_changed_source_has_a_place_of_its_own(tmp_path, monkeypatch):
    from numba import config

    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "kept"))
    places = []
    for number, text in enumerate(("one = 1", "one = 2")):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "same.py").write_text("")
        (folder / "other.py").write_text(text)
        with kept_with(folder, ("same", "other")):
            places.append(config.CACHE_DIR)
    assert places[0] != places[1]
    assert all(Path(place).parent == tmp_path / "kept" for place in places)
    assert str(tmp_path / "kept") == config.CACHE_DIR
