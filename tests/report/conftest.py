"""A report of a small run, made once: two pairs, two methods and the truth, a figure and a notebook."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import nbformat
import numpy as np
import pytest
from phantom_files import SMALL, cached_ct_volume
from PIL import Image

from study import phantom
from study.batch import run_study
from study.datasets import find_dataset
from study.report import write_report

METHODS = ("coarse", "skeleton_graph")
PIXEL = (  # a PNG
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)

WIDGET = '<script src="https://cdn.example/widget.js"></script><table><tr><td>1</table>'


def small_notebook(path: Path) -> None:
    """A notebook with what an executed one holds: TeX, a picture, a wide table, a widget's script, markup in text."""
    picture = nbformat.v4.new_output(  # type: ignore[no-untyped-call]
        "display_data",
        data={"image/png": PIXEL},
    )
    script = nbformat.v4.new_output(  # type: ignore[no-untyped-call]
        "display_data",
        data={"text/html": WIDGET},
    )
    said = nbformat.v4.new_output("stream", name="stdout", text="<b>not bold</b> $x$")  # type: ignore[no-untyped-call]
    cells = [
        nbformat.v4.new_markdown_cell("# What is <seen>?\n\nThe map $F_k$ and $N_{reg}$."),  # type: ignore[no-untyped-call]
        nbformat.v4.new_code_cell("show('$F_k$')", outputs=[picture, script, said]),  # type: ignore[no-untyped-call]
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    nbformat.write(nbformat.v4.new_notebook(cells=cells), path)  # type: ignore[no-untyped-call]


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder of runs with its report."""
    folder = tmp_path_factory.mktemp("runs")
    small_notebook(folder / "notebooks" / "10_made up.ipynb")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(phantom, "ct_volume", cached_ct_volume)
        run_study(find_dataset("phantom", replace(SMALL, max_sources=2)), folder / "phantom", methods=METHODS)
        shades = np.linspace(0, 255, 40 * 60).astype(np.uint8).reshape(40, 60)
        Image.fromarray(shades).save(folder / "phantom" / "waypoints.png")
        write_report(folder, ["phantom"])
        yield folder


@pytest.fixture
def report(runs: Path) -> Path:
    """The report's folder."""
    return runs / "report"
