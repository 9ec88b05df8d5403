"""Methods and rib levels look the same everywhere; a method that is not listed has a style too."""

from __future__ import annotations

import numpy as np
from figure_data import METHODS, metrics, texts
from matplotlib.colors import to_rgb

import study
from study import figures
from study.evaluation import in_order
from study.types import Part


def test_methods_keep_their_colour_and_tuned_ones_are_solid() -> None:
    for name in METHODS:
        shipped, tuned = figures.method_style(name), figures.method_style(f"{name}_tuned")
        assert shipped.colour == tuned.colour
        assert sum(shipped.face) > sum(tuned.face)
    assert len({figures.METHOD_STYLE[name].colour for name in METHODS}) == len(METHODS)
    assert len({figures.METHOD_STYLE[name].marker for name in METHODS}) == len(METHODS)


def test_parameters_are_told_by_the_fill_and_the_surface_by_the_outline() -> None:
    for name in (*METHODS, "bayesian_cpd"):
        whole, visible, tuned, tuned_whole = (
            figures.method_style(name + cell) for cell in ("", "_visible", "_tuned", "_tuned_whole")
        )
        assert {(one.colour, one.marker) for one in (whole, visible, tuned, tuned_whole)} == {
            (whole.colour, whole.marker)
        }
        assert whole.face == visible.face != tuned.face == tuned_whole.face
        assert whole.edge == tuned_whole.edge == whole.colour
        assert visible.edge == tuned.edge == "#000000"
        assert len({one.label for one in (whole, visible, tuned, tuned_whole)}) == 4
    assert figures.method_style("icp_tuned_whole").label == "ICP, tuned, whole"


def test_every_method_of_the_study_is_listed_and_looks_different() -> None:
    listed = {name: figures.METHOD_STYLE[name] for name in study.METHODS}
    looks = {(style.colour, style.marker, style.face, style.edge) for style in listed.values()}
    assert len(looks) == len({style.label for style in listed.values()}) == len(listed)


def test_the_outline_is_drawn() -> None:
    patches = figures.waypoint_boxes(metrics(("icp_tuned", "icp_tuned_whole"))).axes[0].patches
    edges = {tuple(patch.get_edgecolor()[:3]) for patch in patches}
    assert {to_rgb("#000000"), to_rgb(figures.METHOD_STYLE["icp"].colour)} <= edges


def test_a_new_method_needs_no_entry_here() -> None:
    style = figures.method_style("bayesian_cpd")
    assert style == figures.MethodStyle("bayesian cpd", "#33BBEE", "P", tuned=False)  # by its name, on every machine
    assert figures.method_style("bayesian_cpd_tuned") == figures.MethodStyle(
        "bayesian cpd, tuned", style.colour, style.marker, tuned=True, visible=True
    )


def test_a_new_method_looks_like_no_listed_one() -> None:
    new = [figures.method_style(f"method_{k}") for k in range(200)]
    listed = figures.METHOD_STYLE.values()
    assert not {style.colour for style in new} & {style.colour for style in listed}
    assert not {style.marker for style in new} & {style.marker for style in listed}
    assert len({(style.colour, style.marker) for style in new}) == 16  # all of them are used


def test_new_methods_are_drawn_among_the_others_and_named() -> None:
    methods = (*METHODS, "bayesian_cpd", "bayesian_cpd_tuned")
    figure = figures.waypoint_boxes(metrics(methods))
    assert "bayesian cpd, tuned" in texts(figure)
    edges = {tuple(bar.get_edgecolor()[:3]) for bar in figure.axes[0].patches}
    assert to_rgb(figures.method_style("bayesian_cpd").colour) in edges


def test_order_of_methods_does_not_depend_on_their_order_in_the_table() -> None:
    given = ("zeta", "truth", "skeleton_graph", "cpd", "alpha", "icp_tuned", "icp", "cpd")
    wanted = ["icp", "cpd", "skeleton_graph", "icp_tuned", "alpha", "zeta", "truth"]
    assert in_order(given) == in_order(given[::-1]) == wanted


def test_levels_share_a_hue_and_the_left_is_lighter() -> None:
    for level in (2, 3, 4, 5):
        right, left = (np.array(figures.PART_COLOUR[Part.cartilage(side, level)]) for side in ("right", "left"))
        assert (left >= right).all()
        assert left.sum() > right.sum() + 0.3
    assert len(set(figures.PART_COLOUR[Part.STERNUM])) == 1  # neutral
