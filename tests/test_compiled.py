"""Machine code that is kept between runs is that of the sources as they are."""

import importlib
import pkgutil
from pathlib import Path

import pytest
from numba.core.registry import CPUDispatcher

import data_synth
import pipeline
from data_synth import kernels as phantom
from pipeline.compiled import kept_with
from pipeline.evaluation import compiled as dissection
from pipeline.field import fit_kernels as fit
from pipeline.field import kernels as field
from pipeline.registration import compiled as clock


@pytest.mark.parametrize(
    ("door", "marks"),
    [
        (phantom, ("asked", "inner")),
        (clock, ("asked", "inner", "within")),
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
    # Parts of kernels are written in the compiler's own language there.
    for sources in (field._SOURCES, dissection._SOURCES, fit._SOURCES[1]):
        assert "../compiled" in sources


@pytest.mark.parametrize("package", [pipeline, data_synth], ids=["pipeline", "phantom"])
def test_what_calls_compiled_code_of_another_file_is_kept_with_that_file(package):
    """The compiler by itself looks at a function's own file alone."""
    calling = 0
    for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if "training" in found.name or found.name.endswith("__main__"):
            continue
        module = importlib.import_module(found.name)
        for one in vars(module).values():
            if not (isinstance(one, CPUDispatcher) and one.py_func.__module__ == found.name):
                continue
            called = [module.__dict__.get(name) for name in one.py_func.__code__.co_names]
            if any(isinstance(to, CPUDispatcher) and to.__module__ != found.name for to in called):
                calling += 1
                assert "numba-" in one._cache.cache_path, (found.name, one.__name__)
    assert calling > 10


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


@pytest.mark.parametrize("writable", [True, False])
def test_a_folder_that_may_not_be_written_keeps_sources_apart_too(tmp_path, monkeypatch, writable):
    """As of a package that another user installed: there the compiler has one place for all."""
    from numba import config

    monkeypatch.setattr(config, "CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "mine"))
    folder = tmp_path / "package"
    folder.mkdir()
    (folder / "one.py").write_text("")
    if not writable:
        (folder / "__pycache__").write_text("no folder")
    with kept_with(folder, ("one",)):
        place = Path(config.CACHE_DIR)
    assert place.name.startswith("numba-")
    assert place.parent == (folder / "__pycache__" if writable else tmp_path / "mine" / "beatfield")


def test_the_phantom_compiles_where_its_own_place_may_not_be_written(monkeypatch):
    """Installed by another user, say; what it compiles is for this run alone then."""

    def refuse(**_):
        raise PermissionError(13, "Permission denied")

    beside = Path(phantom.__file__).parent / "__pycache__"
    assert phantom._place.__wrapped__() == beside
    monkeypatch.setattr(phantom.tempfile, "TemporaryFile", refuse)
    place = phantom._place.__wrapped__()
    assert place.is_dir()
    assert place != beside
