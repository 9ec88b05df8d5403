"""What holds for every figure. The files beside this one give each an example; here a figure without one fails."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
import io
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import get_type_hints

import matplotlib
import pytest
from figure_data import texts
from matplotlib.figure import Figure
from PIL import Image

from study import figures
from study.errors import StudyError

ROOM = Path(figures.__file__).parent
MODULES = {
    path.stem: importlib.import_module(f"study.figures.{path.stem}")
    for path in sorted(ROOM.glob("*.py"))
    if path.stem != "__init__"
}


def loaded(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"examples_of_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def gathered(name: str) -> dict[str, Callable[[], Figure]]:
    """The dictionaries of that name in the files beside this one, as one; no key occurs twice."""
    found: dict[str, Callable[[], Figure]] = {}
    for path in sorted(Path(__file__).parent.glob("test_*.py")):
        more = {} if path == Path(__file__) else getattr(loaded(path), name, {})
        assert not found.keys() & more.keys(), path
        found |= more
    return found


def drawing(module: ModuleType) -> set[str]:
    """Public functions that a module defines and that give a figure."""
    own = {
        name: thing for name, thing in vars(module).items() if inspect.isfunction(thing) and not name.startswith("_")
    }
    return {
        name
        for name, thing in own.items()
        if thing.__module__ == module.__name__ and get_type_hints(thing).get("return") is Figure
    }


EXAMPLES, REFUSED = gathered("EXAMPLES"), gathered("REFUSED")


def test_every_figure_has_an_example() -> None:
    public = {name for module in MODULES.values() for name in drawing(module)}
    assert len(public) >= 18
    assert public == set(EXAMPLES)


@pytest.mark.parametrize("name", MODULES)
def test_the_room_offers_what_its_modules_share_and_every_figure(name: str) -> None:
    module = MODULES[name]
    shared = getattr(module, "__all__", [])
    assert drawing(module) <= set(shared)
    assert set(shared) <= set(figures.__all__)
    for word in shared:
        assert getattr(figures, word) is getattr(module, word)


def test_the_room_offers_nothing_twice() -> None:
    assert len(set(figures.__all__)) == len(figures.__all__)
    assert not set(figures.__all__) & set(MODULES)  # a figure would hide the module of its name


@pytest.mark.parametrize("name", EXAMPLES)
def test_every_figure_is_small_says_mm_and_leaves_no_global_state(name: str) -> None:
    before = dict(matplotlib.rcParams)
    figure = EXAMPLES[name]()
    assert isinstance(figure, figures.StudyFigure)
    image = figures.png(figure)
    assert image[:4] == b"\x89PNG"
    assert len(image) < 250_000
    assert Image.open(io.BytesIO(image)).width == 1650
    assert "mm" in texts(figure)
    assert dict(matplotlib.rcParams) == before


@pytest.mark.parametrize("name", ["ct_slice", "registration_grid", "waypoint_boxes", "error_budget"])
def test_the_same_data_give_the_same_bytes(name: str) -> None:
    assert figures.png(EXAMPLES[name]()) == figures.png(EXAMPLES[name]())


@pytest.mark.parametrize("name", REFUSED)
def test_nothing_to_draw_is_refused(name: str) -> None:
    with pytest.raises(StudyError, match="expected"):
        REFUSED[name]()


def test_figures_import_no_method_and_no_pyplot() -> None:
    modules = set()
    for path in ROOM.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                modules.add(node.module)
            elif isinstance(node, ast.Import):
                modules.update(alias.name for alias in node.names)
    ours = {name for name in modules if name and name.startswith("study") and not name.startswith("study.figures")}
    nouns = {"study.errors", "study.geometry.points", "study.naming", "study.skeleton.graph", "study.types"}
    nouns |= {"study.ct.landmarks", "study.ct.wall"}
    judged = {f"study.evaluation.{name}" for name in ("metrics", "pair", "statistics")}
    assert ours == nouns | judged
    assert "matplotlib.pyplot" not in modules
