"""Drawn people have the published sizes, and what no publication gives is what the open cohort has."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from study.phantom import sizes
from study.phantom.subject import SUBJECTS, draw_subject
from study.phantom.truth import measures


def test_sizes_are_the_published_ones():
    drawn = [measures(draw_subject(name, seed)) for seed in range(6) for name in SUBJECTS]
    assert len(drawn) == 36
    for key, (mean, sd) in {
        "cartilage_right_4_mm": (55.8, 9.8),
        "cartilage_left_4_mm": (55.8, 9.8),
        "cartilage_right_5_mm": (70.0, 10.8),
        "cartilage_left_5_mm": (70.0, 10.8),
        "manubrium_mm": (48.95, 6.0),  # women and men alike often
        "body_mm": (94.5, 14.0),
        "sternal_angle_deg": (163.0, 5.0),
    }.items():
        values = np.array([sizes[key] for sizes in drawn])
        # Draws end at 1.3 SD; bending and breathing add a little.
        assert np.abs(values - mean).max() < 2.2 * sd, key
        assert np.abs(values.mean() - mean) < 0.5 * sd, key
        assert values.std() > 0.4 * sd, key
    widths = [sizes["sternum_width_mm"] for sizes in drawn]
    assert 18 < min(widths) < max(widths) < 32
    for side in ("right", "left"):  # each level is longer than the one above
        lengths = np.array([[sizes[f"cartilage_{side}_{level}_mm"] for level in (2, 3, 4, 5)] for sizes in drawn])
        assert (np.diff(lengths, axis=1) > 0).mean() > 0.95


def test_what_no_publication_gives_is_what_the_open_cohort_has():
    """The constants are those of results/anatomy.csv: means and population SDs over people, sides averaged."""
    table = pd.read_csv(Path(__file__).parents[2] / "results" / "anatomy.csv")

    def over_people(quantity: str, parts: str) -> pd.Series:
        chosen = table[(table["quantity"] == quantity) & table["part"].str.fullmatch(parts)]
        return chosen.groupby("subject")["value"].mean()

    for level, (mean, sd) in sizes.MEASURED_LENGTH_MM.items():
        found = over_people("length", f".*_{level}")
        assert len(found) == 4
        assert (found.mean(), found.std(ddof=0)) == pytest.approx((mean, sd), abs=0.06)
    for level, mean in sizes.MEASURED_WIDTH_MM.items():
        assert over_people("width", f".*_{level}").mean() == pytest.approx(mean, abs=0.06)
    ((width, width_sd), thickness) = sizes.MEASURED_STERNUM_MM
    for (mean, sd), found in (
        (sizes.MEASURED_THICKNESS_MM, over_people("thickness", ".*_[2-5]")),
        ((width, width_sd), over_people("width", "sternum")),
        (sizes.MEASURED_HU, over_people("density_mean", "cartilages")),
    ):
        assert (found.mean(), found.std(ddof=0)) == pytest.approx((mean, sd), abs=0.06)
    assert over_people("thickness", "sternum").mean() == pytest.approx(thickness, abs=0.06)
    curvature = over_people("wall_curvature", "cartilages")
    mean, sd = sizes.WALL_PER_M
    assert curvature.min() < mean - sizes.MAX_SD * sd
    assert curvature.mean() < mean
    assert mean + sizes.MAX_SD * sd < curvature.max()
