"""The picture of a cloud is a picture of that cloud, and no word of it is read as HTML."""

import base64
import io
import re
import subprocess
import sys

import numpy as np
import pytest
from oracles import toy_chest
from PIL import Image

from study import preview
from study.types import Part, PointCloud, RigidTransform

CLOUD = toy_chest(np.random.default_rng(0), 9000)


def pixels(png: bytes) -> np.ndarray:
    image = Image.open(io.BytesIO(png))
    image.verify()
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def inked(picture: np.ndarray) -> np.ndarray:
    return (picture < 255).any(axis=2)


def test_a_cloud_is_drawn_from_the_front_head_up_in_the_colours_of_its_parts():
    picture = pixels(preview.by_part(CLOUD.points, CLOUD.parts))
    assert picture.shape[1] == preview.WIDTH_PX
    assert 0.1 < inked(picture).mean() < 0.9
    colours = np.unique(picture[inked(picture)], axis=0)
    assert len(colours) == 9  # the sternum and eight cartilages
    # The patient's right is on the viewer's left, and darker; the 2nd cartilages are above the 5th.
    columns = {}
    rows = {}
    for level, dark in zip((2, 3, 4, 5), preview._LEVELS, strict=True):
        rows[level], columns[level] = (where.mean() for where in np.nonzero((picture == dark).all(axis=2)))
    assert max(columns.values()) < preview.WIDTH_PX / 2
    assert rows[2] < rows[3] < rows[4] < rows[5]


@pytest.mark.parametrize("seed", range(4))
def test_any_pose_is_seen_along_its_thinnest_side(seed):
    moved = CLOUD.moved(RigidTransform.random(np.random.default_rng(seed)))
    share = inked(pixels(preview.by_part(moved.points))).mean()
    assert share > 0.15  # from its edge a chest is a strip


def test_nearer_points_cover_farther_ones():
    side = np.linspace(-50, 50, 120)
    x, z = (grid.ravel() for grid in np.meshgrid(side, side))
    front, back = np.column_stack([x, 0 * x + 1, z]), np.column_stack([x, 0 * x, z])
    for points, near in ((np.vstack([back, front]), len(x)), (np.vstack([front, back]), 0)):
        parts = np.full(len(points), int(Part.STERNUM))
        parts[near : near + len(x)] = Part.RIGHT_2
        picture = pixels(preview.by_part(points, parts))
        assert (picture[inked(picture)] == preview._LEVELS[0]).all()


def test_a_size_goes_from_grey_to_red():
    heights = CLOUD.points[:, 2]
    picture = pixels(preview.by_size(CLOUD.points, heights - heights.min())).astype(float)
    red = picture[:, :, 0] - picture[:, :, 1]
    top, bottom = red[:10].max(), red[-10:].max()
    assert top > 100 > 50 > bottom
    still = pixels(preview.by_size(CLOUD.points, np.zeros(len(CLOUD))))
    assert len(np.unique(still[inked(still)], axis=0)) == 1


def test_a_straight_line_is_drawn_too():
    line = np.outer(np.linspace(-50, 50, 60), [1.0, 0, 0])
    assert inked(pixels(preview.by_part(line))).any()
    assert inked(pixels(preview.by_part(line[:, [1, 2, 0]]))).any()


def test_a_cloud_shows_itself_in_a_notebook():
    words = CLOUD._repr_html_()
    assert len(words) < 20_000
    encoded = re.search(r'src="data:image/png;base64,([A-Za-z0-9+/=]+)"', words)
    assert inked(pixels(base64.b64decode(encoded[1]))).any()
    for word in ("toy", "9,000", "sternum, right_2", "left_5", " mm"):
        assert word in words
    assert "not labelled" in PointCloud(CLOUD.points)._repr_html_()


def test_names_are_escaped():
    words = PointCloud(CLOUD.points, name='<script>"&')._repr_html_()
    assert "<script>" not in words
    assert "&lt;script&gt;&quot;&amp;" in words
    assert "<i>" not in preview.card("a", {"<i>": "<u>"}, b"").replace("<i>&lt;i&gt;</i>", "")
    assert "<u>" not in preview.card("a", {"<i>": "<u>"}, b"")


def test_types_need_no_picture_library():
    code = "import sys, study.registration; sys.exit('PIL' in sys.modules or 'matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
