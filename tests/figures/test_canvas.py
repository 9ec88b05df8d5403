"""The page: chest coordinates in every frame, pictures of the same bytes."""

from __future__ import annotations

import io

import numpy as np
import pandas as pd
import pytest
from figure_data import CLOUD, TETRAHEDRON, metrics
from matplotlib.collections import PathCollection
from matplotlib.colors import to_rgb
from PIL import Image

from study import figures
from study.errors import StudyError
from study.figures.canvas import require_columns
from study.types import RigidTransform


def test_a_notebook_shows_a_figure_by_itself() -> None:
    figure = figures.som_progress({"CT": (5.0, 3.0, 2.5)})
    assert isinstance(figure, figures.StudyFigure)
    picture, shown = figure._repr_png_()
    assert picture == figures.png(figure)
    assert shown == {"width": 990, "height": 306}


def test_png_keeps_flat_colours_exact() -> None:
    figure = figures.mesh_and_cloud(TETRAHEDRON, CLOUD)
    shown = np.asarray(Image.open(io.BytesIO(figures.png(figure))).convert("RGB")).reshape(-1, 3)
    wanted = np.round(255 * np.array(to_rgb("#8c8c8c")))  # the sternum's patch in the legend
    assert (shown == wanted).all(axis=1).sum() > 200
    assert (shown == 255).all(axis=1).mean() > 0.3


def test_a_figure_is_150_dpi_and_no_taller_than_a_screen() -> None:
    many = figures.sensitivity(
        pd.DataFrame(
            [
                {"choice": f"c{k}", "option": o, "role": r, "case": "a", "value": 2.0 + 0.1 * k}
                for k in range(40)
                for o, r in (("x", "paper"), ("y", "authors"))
            ]
        )
    )
    image = Image.open(io.BytesIO(figures.png(many)))
    assert image.height <= 1400
    np.testing.assert_allclose(image.info["dpi"], 150, atol=0.1)


def test_kept_pictures_are_png_and_svg_with_the_same_bytes_every_time() -> None:
    def made() -> dict[str, bytes]:
        return figures.picture_files({"maps": figures.som_progress({"CT": (5.0, 3.0, 2.5)})})

    one = made()
    assert set(one) == {"maps.png", "maps.svg"}
    assert one == made()
    assert b"<svg" in one["maps.svg"]
    assert b"<dc:date>" not in one["maps.svg"]


def test_the_patients_right_is_on_the_viewers_left() -> None:
    figure = figures.mesh_and_cloud(TETRAHEDRON, CLOUD)
    places = {text.get_text(): text.get_position() for text in figure.axes[1].texts}
    assert places["R2"][0] < 0 < places["L2"][0]
    assert places["R5"][1] < places["R2"][1]
    assert places["R"][0] < places["L"][0]
    low, high = figure.axes[1].get_xlim()
    assert low < high


def test_views_do_not_depend_on_the_frame() -> None:
    motion = RigidTransform.random(np.random.default_rng(3))
    moved = figures.mesh_and_cloud(
        TETRAHEDRON.moved(motion), CLOUD.moved(motion), T_cloud_chest=motion @ figures.T_RAS_CHEST
    )
    plain = figures.mesh_and_cloud(TETRAHEDRON, CLOUD)
    dots = [figure.axes[1].findobj(PathCollection)[0].get_offsets() for figure in (plain, moved)]
    np.testing.assert_allclose(np.sort(dots[0], axis=0), np.sort(dots[1], axis=0), atol=1e-6)


def test_a_table_without_a_column_or_a_row_is_refused_by_name() -> None:
    require_columns(metrics(), ("source", "value"), "metrics")
    with pytest.raises(StudyError, match="got none of colour, size; pass metrics"):
        require_columns(metrics(), ("source", "colour", "size"), "metrics")
    with pytest.raises(StudyError, match="expected metrics to draw, got none"):
        require_columns(metrics().iloc[:0], ("source",), "metrics")
