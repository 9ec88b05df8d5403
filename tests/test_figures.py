"""Figures show what they were given, in agreed colours, and refuse nothing to show."""

from __future__ import annotations

import ast
import io
from collections.abc import Callable
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import pytest
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch, Polygon, Rectangle
from matplotlib.quiver import Quiver
from matplotlib.text import Text
from PIL import Image

from study import figures
from study.errors import StudyError
from study.types import CARTILAGES, Mesh, Part, PointCloud, RigidTransform, SkeletonGraph, Volume, Waypoints

METHODS = ("icp", "nonrigid_icp", "cpd", "skeleton_graph")
SUBJECTS = ("ct1", "ct2", "ct10")
SOURCES = Path(figures.__file__).parent


def texts(figure: Figure) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(Text))


def chest_points(n: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """A stick chest in RAS+: a sternum and eight straight branches, with parts."""
    along = np.linspace(0, 1, n)
    points = [np.column_stack([0 * along, 0 * along, 40 - 80 * along])]
    parts = [np.zeros(n)]
    for part in CARTILAGES:
        side = 1 if part.side == "right" else -1
        z = 60 - 20 * part.level
        points.append(np.column_stack([side * (15 + 50 * along), -10 * along, z - 10 * along]))
        parts.append(np.full(n, int(part)))
    return np.concatenate(points), np.concatenate(parts).astype(np.int64)


POINTS, PARTS = chest_points()
FRONT = np.array([0.0, 1.0, 0.0])
CLOUD = PointCloud(POINTS, "chest", PARTS)
TETRAHEDRON = Mesh(
    np.array([[0.0, 0, 0], [30, 0, 0], [0, 30, 0], [0, 0, 30]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
    np.array([0, 1, 5, 8]),
)
LABELS = tuple(f"{s}{k}-{k + 1}.{i + 1}" for s in "RL" for k, count in ((2, 3), (3, 3), (4, 4)) for i in range(count))
TRUTH = Waypoints(POINTS[np.linspace(60, len(POINTS) - 1, 20).astype(int)], LABELS)
GRAPH = SkeletonGraph(POINTS[::90], np.array([[0, 1], [1, 0], [1, 2], [3, 2]]), PARTS[::90])


def volumes() -> tuple[Volume, Volume]:
    """A block of soft tissue and, on a crop of its grid, a mask with a sternum, R3 and L3."""
    values = np.full((40, 20, 30), 40, dtype=np.int16)
    mask = np.full((30, 10, 20), int(Part.UNKNOWN), dtype=np.int8)
    mask[13:17, 3:7, 4:16] = Part.STERNUM
    mask[18:28, 3:7, 8:12] = Part.RIGHT_3
    mask[2:12, 3:7, 8:12] = Part.LEFT_3
    spacing = np.array([1.5, 1.5, 2.0])
    whole = Volume(values, spacing, RigidTransform(translation=np.array([-30.0, 10, -20])), "ct")
    return whole, Volume(mask, spacing, RigidTransform(translation=whole.to_mm([[5, 4, 6]])[0]), "parts")


def metrics(methods: tuple[str, ...] = METHODS, n_targets: int = 1) -> pd.DataFrame:
    rng = np.random.default_rng(0)
    rows = []
    for subject in SUBJECTS:
        for target in range(n_targets):
            for method in methods:
                case = {"dataset": "phantom", "subject": subject, "target": f"p{target}", "method": method, "seed": 0}
                values = [("waypoint_error", i, rng.gamma(4.0)) for i in range(20)] + [("hd", 0, rng.uniform(8, 12))]
                rows += [
                    {**case, "metric": m, "index": i, "value": v, "unit": "mm", "status": "ok"} for m, i, v in values
                ]
    return pd.DataFrame(rows)


def failing(subject: str = "ct2", method: str = "cpd") -> pd.DataFrame:
    """`metrics` in which one case failed."""
    whole = metrics()
    lost = (whole["subject"] == subject) & (whole["method"] == method)
    row = whole[lost].head(1).assign(metric="case", index=0, value=np.nan, unit="", status="failed: no sternum")
    return pd.concat([whole[~lost], row], ignore_index=True)


def budget() -> pd.DataFrame:
    rows = []
    for k, source in enumerate(("none", "latency", "all")):
        rows.append({"source": source, "metric": "surface_distance", "method": "", "value": 0.2 + k})
        rows += [
            {"source": source, "metric": "waypoint_error", "method": method, "value": 2.0 + k + seed / 10}
            for method in METHODS
            for seed in range(3)
        ]
    return pd.DataFrame(rows)


def choices() -> pd.DataFrame:
    rows = [
        ("rate", "constant", "paper", 2.0),
        ("rate", "compounding", "authors", 2.5),
        ("rate", "linear", "alternative", 1.75),
    ]
    return pd.DataFrame(
        [
            {"choice": c, "option": o, "role": r, "case": f"ct{k}", "value": v + k}
            for c, o, r, v in rows
            for k in range(4)
        ]
    )


PAPER = pd.DataFrame({"mean": [17.35, 9.48], "sd": [3.54, 0.27]}, index=["icp", "skeleton_graph"])
VIEW = figures.CoarseView(
    plane=POINTS[:, [0, 2]],
    rectangles=[(5.0, np.zeros(2), 10.0), (3.0, np.ones(2), 4.0), (2.0, np.ones(2), 3.0)],
    local=POINTS[:, [0, 2]],
    edges_mm=(15.0, 14.0),
    seeds=np.array([[s * 20.0, y] for s in (-1, 1) for y in (-40.0, -20, 0, 20)]),
    chest=POINTS[:, [0, 2]] * [-1, 1],
    parts=PARTS,
)
TIMES = np.arange(0, 10, 0.05)
EVERY: dict[str, Callable[[], Figure]] = {
    "ct_slice": lambda: figures.ct_slice(*volumes()),
    "anatomy_overview": lambda: figures.anatomy_overview({"a": volumes(), "b": volumes()}),
    "mesh_and_cloud": lambda: figures.mesh_and_cloud(TETRAHEDRON, CLOUD),
    "coarse_steps": lambda: figures.coarse_steps({"CT": VIEW, "US": VIEW}),
    "coarse_overlay": lambda: figures.coarse_overlay(POINTS + 300.0, POINTS, POINTS + 1.0),
    "skeleton_graph": lambda: figures.skeleton_graph(GRAPH, POINTS),
    "graph_triptych": lambda: figures.graph_triptych(GRAPH, GRAPH, GRAPH, POINTS, POINTS),
    "som_progress": lambda: figures.som_progress({"CT": (5.0, 3.0, 2.5), "US": (4.0, 2.0)}),
    "registration_grid": lambda: figures.registration_grid({m: POINTS + 1.0 for m in METHODS[:3]}, POINTS),
    "transferred_path": lambda: figures.transferred_path(POINTS, TRUTH, {m: TRUTH.points + 1.0 for m in METHODS}),
    "waypoint_boxes": lambda: figures.waypoint_boxes(metrics(), paper=PAPER),
    "hd_bars": lambda: figures.hd_bars(metrics(), paper=PAPER),
    "sensitivity": lambda: figures.sensitivity(choices()),
    "error_budget": lambda: figures.error_budget(budget()),
    "sweep_in_space": lambda: figures.sweep_in_space(POINTS + 30.0 * FRONT, CLOUD, TETRAHEDRON),
    "frame_with_mask": lambda: figures.frame_with_mask(np.eye(20, 30, dtype=bool), (0.2, 0.1), np.ones((20, 30))),
    "latency_fit": lambda: figures.latency_fit(100 + 5 * np.sin(TIMES - 0.268), TIMES, np.sin(TIMES), TIMES, 0.268),
}


@pytest.mark.parametrize("name", EVERY)
def test_every_figure_is_small_says_mm_and_leaves_no_global_state(name: str) -> None:
    before = dict(matplotlib.rcParams)
    figure = EVERY[name]()
    image = figures.png(figure)
    assert image[:4] == b"\x89PNG"
    assert len(image) < 150_000
    assert Image.open(io.BytesIO(image)).width == 990
    assert "mm" in texts(figure)
    assert dict(matplotlib.rcParams) == before


@pytest.mark.parametrize("name", ["ct_slice", "registration_grid", "waypoint_boxes", "error_budget"])
def test_the_same_data_give_the_same_bytes(name: str) -> None:
    assert figures.png(EVERY[name]()) == figures.png(EVERY[name]())


def test_a_notebook_shows_a_figure_by_itself() -> None:
    figure = EVERY["som_progress"]()
    assert isinstance(figure, figures.StudyFigure)
    assert figure._repr_png_() == figures.png(figure)


def test_png_keeps_flat_colours_exact() -> None:
    figure = figures.hd_bars(metrics(("icp_tuned",)))
    shown = np.asarray(Image.open(io.BytesIO(figures.png(figure))).convert("RGB")).reshape(-1, 3)
    wanted = np.round(255 * np.array(to_rgb(figures.METHOD_STYLE["icp"].colour)))
    assert (shown == wanted).all(axis=1).sum() > 1000
    assert (shown == 255).all(axis=1).mean() > 0.3


def test_figures_import_no_method_and_no_pyplot() -> None:
    modules = set()
    for path in SOURCES.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                modules.add(node.module)
            elif isinstance(node, ast.Import):
                modules.update(alias.name for alias in node.names)
    ours = {name for name in modules if name and name.startswith("study")}
    allowed = {"study.errors", "study.types", "study.geometry", "study.metrics"}
    assert ours <= allowed | {name for name in ours if name.startswith("study.figures")}
    assert "matplotlib.pyplot" not in modules


# ----------------------------------------------------------------------------------------------------------- styles


def test_methods_keep_their_colour_and_tuned_ones_are_solid() -> None:
    for name in METHODS:
        shipped, tuned = figures.method_style(name), figures.method_style(f"{name}_tuned")
        assert shipped.colour == tuned.colour
        assert shipped.hatch
        assert not tuned.hatch
        assert sum(shipped.face) > sum(tuned.face)
    assert len({figures.METHOD_STYLE[name].colour for name in METHODS}) == len(METHODS)
    assert len({figures.METHOD_STYLE[name].marker for name in METHODS}) == len(METHODS)


def test_an_unknown_method_has_one_style_of_its_own() -> None:
    style = figures.method_style("bayesian_cpd")
    assert style == figures.method_style("bayesian_cpd")
    assert style.label == "bayesian cpd"
    assert style.colour not in {known.colour for known in figures.METHOD_STYLE.values()}
    assert figures.method_style("bayesian_cpd_tuned").tuned


def test_order_of_methods_does_not_depend_on_their_order_in_the_table() -> None:
    given = ("zeta", "skeleton_graph", "cpd", "alpha", "icp_tuned", "icp")
    assert figures.in_order(given) == ["icp", "icp_tuned", "cpd", "skeleton_graph", "alpha", "zeta"]


def test_levels_share_a_hue_and_the_left_is_lighter() -> None:
    for level in (2, 3, 4, 5):
        right, left = (np.array(figures.PART_COLOUR[Part.cartilage(side, level)]) for side in ("right", "left"))
        assert (left >= right).all()
        assert left.sum() > right.sum() + 0.3
    assert len(set(figures.PART_COLOUR[Part.STERNUM])) == 1  # neutral


# ------------------------------------------------------------------------------------------------------- orientation


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


def test_ct_slice_draws_right_parts_left_and_contours_where_the_mask_is() -> None:
    volume, mask = volumes()
    axial = figures.ct_slice(volume, mask).axes[0]
    by_colour = {}
    for drawn in axial.collections:
        vertices = np.concatenate([path.vertices for path in drawn.get_paths() if len(path.vertices)])
        by_colour[tuple(np.round(drawn.get_edgecolor()[0][:3], 3))] = vertices
    right = by_colour[tuple(np.round(figures.PART_COLOUR[Part.RIGHT_3], 3))]
    left = by_colour[tuple(np.round(figures.PART_COLOUR[Part.LEFT_3], 3))]
    assert right[:, 0].max() < left[:, 0].min()
    inside = mask.to_mm(np.argwhere(mask.values == Part.RIGHT_3))
    np.testing.assert_allclose(-right[:, 0].max(), inside[:, 0].min() - 0.75, atol=1e-6)
    np.testing.assert_allclose(-right[:, 0].min(), inside[:, 0].max() + 0.75, atol=1e-6)
    np.testing.assert_allclose(right[:, 1].max(), inside[:, 1].max() + 0.75, atol=1e-6)


def test_the_legend_of_a_slice_names_only_what_is_there() -> None:
    shown = texts(figures.ct_slice(*volumes()))
    assert "sternum" in shown
    assert "cartilage 3" in shown
    assert "cartilage 4" not in shown


def test_image_pixels_lie_at_their_millimetres() -> None:
    volume, mask = volumes()
    values = np.array(volume.values)
    values[7, :, :] = 300  # one sagittal plane
    image = figures.ct_slice(volume.with_values(values), mask).axes[0].get_images()[0]
    low, high, *_ = image.get_extent()
    column = int(np.argmax(np.asarray(image.get_array())[3]))
    x = low + (column + 0.5) * (high - low) / volume.shape[0]
    np.testing.assert_allclose(x, -volume.to_mm([[7, 0, 0]])[0, 0], atol=1e-9)


def test_frame_has_its_size_in_millimetres_and_depth_points_down() -> None:
    figure = EVERY["frame_with_mask"]()
    assert len(figure.axes) == 2
    image = figure.axes[0].get_images()[0]
    np.testing.assert_allclose(image.get_extent(), (-0.1, 5.9, 1.95, -0.05))
    bottom, top = figure.axes[0].get_ylim()
    assert bottom > top


# ---------------------------------------------------------------------------------------------------------- contents


def test_coarse_steps_shows_three_rectangles_and_eight_seeds_a_cloud() -> None:
    figure = EVERY["coarse_steps"]()
    assert len(figure.axes) == 6
    rectangles = [p for p in figure.axes[0].patches if isinstance(p, Polygon)]
    assert len(rectangles) == 3
    corners = rectangles[0].get_xy()[:4]
    np.testing.assert_allclose(np.sort(np.linalg.norm(np.diff(corners, axis=0), axis=1)), [30, 30, 90])
    long = corners[2] - corners[1]
    np.testing.assert_allclose(np.degrees(np.arctan2(-long[0], long[1])), 10.0)  # counter-clockwise from y
    assert len(figure.axes[1].collections[1].get_offsets()) == 8


def test_one_way_edges_are_arrows_in_their_direction() -> None:
    np.testing.assert_array_equal(figures.one_way(GRAPH.edges), [False, False, True, True])
    figure = figures.skeleton_graph(GRAPH)
    (arrows,) = figure.axes[0].findobj(Quiver)
    nodes = GRAPH.nodes[:, [0, 2]] * [-1, 1]
    np.testing.assert_allclose(arrows.get_offsets(), nodes[[1, 3]])
    np.testing.assert_allclose(np.column_stack([arrows.U, arrows.V]), nodes[[2, 2]] - nodes[[1, 3]])
    assert "2 of them one-way" in texts(figure)


def test_fitted_graphs_have_no_arrows() -> None:
    top, *fitted = EVERY["graph_triptych"]().axes
    assert len(top.findobj(Quiver)) == 1
    assert [len(ax.findobj(Quiver)) for ax in fitted] == [0, 0]
    assert [len(ax.findobj(LineCollection)[0].get_segments()) for ax in fitted] == [len(GRAPH.edges)] * 2


def test_before_the_alignment_only_the_patients_axes_are_named() -> None:
    before, after, _ = EVERY["coarse_overlay"]().axes
    assert "US patient's axes" in before.get_xlabel()
    assert not before.texts
    assert {text.get_text() for text in after.texts} == {"R", "L"}


def test_triptych_numbers_every_node_of_the_template() -> None:
    figure = EVERY["graph_triptych"]()
    numbers = {text.get_text() for text in figure.axes[0].texts}
    assert {str(k) for k in range(len(GRAPH))} <= numbers


def test_registrations_share_one_colour_scale() -> None:
    warped = {"icp": POINTS + 8.0 * FRONT, "skeleton_graph": POINTS + FRONT}
    figure = figures.registration_grid(warped, POINTS)
    scales = {
        drawn.get_clim()
        for drawn in figure.findobj(PathCollection)
        if drawn.get_array() is not None and len(drawn.axes.texts)
    }
    assert len(scales) == 1
    assert "Skeleton graph\nmean 1.0" in texts(figure)
    assert "ICP\nmean" in figure.axes[0].get_title(loc="left")


def test_path_joins_waypoints_within_a_space_only_and_says_the_error() -> None:
    figure = figures.transferred_path(POINTS, TRUTH, {"icp": TRUTH.points + np.array([0.0, 4.0, 3.0])})
    ax = figure.axes[0]
    assert sorted(len(line.get_xdata()) for line in ax.lines) == [3] * 8 + [4] * 4
    assert "mean error 5.0 mm, in this view 3.0 mm" in ax.get_title(loc="left")
    (errors,) = ax.findobj(LineCollection)
    assert len(errors.get_segments()) == 20
    assert figures.SIMULATED in texts(figure)


def test_boxes_hold_every_waypoint_of_every_ct_and_method() -> None:
    table = metrics()
    figure = figures.waypoint_boxes(table)
    (ax,) = figure.axes
    boxes = [p for p in ax.patches if isinstance(p, PathPatch)]
    assert len(boxes) == len(SUBJECTS) * len(METHODS)
    assert [label.get_text() for label in ax.get_xticklabels()] == ["ct1", "ct2", "ct10"]
    assert [b.get_edgecolor()[:3] for b in boxes[:4]] == [to_rgb(figures.METHOD_STYLE[m].colour) for m in METHODS]
    dots = [drawn.get_offsets() for drawn in ax.findobj(PathCollection)]
    assert sum(len(offsets) for offsets in dots) == len(SUBJECTS) * len(METHODS) * 20
    first = table[(table["subject"] == "ct1") & (table["method"] == "icp") & (table["metric"] == "waypoint_error")]
    np.testing.assert_allclose(dots[0][:, 1], first["value"])
    assert ax.get_ylabel() == "Waypoint error (mm)"
    assert "n = 20" in texts(figure)
    assert "simulated patient" in texts(figure)


def test_boxes_do_not_depend_on_the_order_of_rows() -> None:
    table = metrics()
    assert figures.png(figures.waypoint_boxes(table)) == figures.png(
        figures.waypoint_boxes(table.sort_values("method", kind="stable"))
    )


def test_a_failed_case_is_named_where_its_box_would_be() -> None:
    for draw in (figures.waypoint_boxes, figures.hd_bars):
        figure = draw(failing())
        (word,) = [text for text in figure.axes[0].texts if text.get_text().strip() == "failed"]
        assert word.get_color() == figures.METHOD_STYLE["cpd"].colour
    assert len([p for p in figures.waypoint_boxes(failing()).axes[0].patches if isinstance(p, PathPatch)]) == 11
    assert ", n=2" in texts(figures.hd_bars(failing()))


def test_a_subject_whose_methods_all_failed_says_so_once() -> None:
    table = pd.concat([failing(method=method).query("subject == 'ct2' and method == @method") for method in METHODS])
    whole = metrics()
    table = pd.concat([whole[whole["subject"] != "ct2"], table], ignore_index=True)
    for draw in (figures.waypoint_boxes, figures.hd_bars):
        words = [text.get_text() for text in draw(table).axes[0].texts if "failed" in text.get_text()]
        assert words == ["failed"]


def test_the_truth_is_drawn_last_like_a_tuned_method() -> None:
    methods = ("truth", *METHODS)
    assert figures.in_order(methods)[-1] == "truth"
    style = figures.method_style("truth")
    assert (style.tuned, style.hatch, style.marker) == (True, "", "*")
    for draw in (figures.waypoint_boxes, figures.hd_bars):
        assert "Perfect (truth)" in texts(draw(metrics(methods), paper=PAPER))


def test_uneven_boxes_print_their_own_n() -> None:
    table = metrics().drop(index=0)
    shown = texts(figures.waypoint_boxes(table))
    assert "n=19" in shown
    assert shown.count("n=20") == 11


def test_bars_end_with_the_mean_and_the_population_sd() -> None:
    table = metrics(n_targets=2)
    figure = figures.hd_bars(table, paper=PAPER)
    (ax,) = figure.axes
    bars = [p for p in ax.patches if isinstance(p, Rectangle) and p.get_width() == pytest.approx(0.86)]
    assert len(bars) == (len(SUBJECTS) + 1) * len(METHODS)
    icp = table[(table["method"] == "icp") & (table["metric"] == "hd")].groupby("subject")["value"].mean()
    assert bars[3].get_height() == pytest.approx(icp.mean())
    assert f"{icp.mean():.2f}±{icp.std(ddof=0):.2f}" in texts(figure)
    assert "paper, other data" in texts(figure)


def test_paper_markers_are_hollow_at_the_papers_numbers() -> None:
    figure = figures.hd_bars(metrics(), paper=PAPER)
    hollow = [line for line in figure.axes[0].lines if line.get_markerfacecolor() == "white"]
    assert sorted(line.get_ydata()[0] for line in hollow) == [9.48, 17.35]


def test_sensitivity_shows_paired_differences() -> None:
    figure = figures.sensitivity(choices())
    shown = texts(figure)
    assert "+0.50 (n=4)" in shown
    assert "−0.25 (n=4)" in shown
    assert "constant → compounding" in shown
    cloud = figure.axes[0].collections[0].get_offsets()
    np.testing.assert_allclose(cloud[:, 0], 0.5)


def test_a_wide_option_does_not_stretch_the_axis_and_says_how_far_it_goes() -> None:
    table = choices()
    wide = table[table["option"] == "compounding"].assign(option="all nodes", value=lambda t: t["value"] + 4.0)
    near = table[table["option"] == "constant"].assign(option="others", role="yardstick", choice="draws")
    draws = table[table["option"] == "constant"].assign(choice="draws")
    figure = figures.sensitivity(pd.concat([table, wide, draws, near]))
    (ax,) = figure.axes
    assert ax.get_xlim()[1] < 1.3
    assert "4 cases, to +4.50" in texts(figure)
    assert "0.00 (n=4)" in texts(figure)
    assert not any(sign + "0.00" in texts(figure) for sign in "+-−")
    assert len([p for p in ax.patches if isinstance(p, Rectangle)]) == 1  # the yardstick's band


def paired() -> pd.DataFrame:
    rows = [
        {"dataset": dataset, "method": method, "difference": k - 2.0}
        for dataset in ("open", "phantom")
        for method in (*METHODS[:3], "truth")
        for k in range(3)
    ]
    return pd.DataFrame(rows)


def test_paired_differences_say_once_which_side_is_better() -> None:
    figure = figures.paired_differences(paired(), "skeleton_graph", "Waypoint error")
    shown = texts(figure)
    assert shown.count("better") == 1
    assert shown.startswith("Waypoint error: ") or "\nWaypoint error: " in shown
    assert [ax.get_xlabel() for ax in figure.axes] == ["difference (mm)"] * 2
    assert "Perfect (truth)" in shown


def test_error_views_explain_bar_and_number() -> None:
    shown = texts(figures.error_views(metrics(), ("waypoint_error",)))
    assert "mean waypoint error of a pair (mm)" in shown
    assert "population SD" in shown


def test_error_budget_keeps_the_order_of_sources_and_starts_at_zero() -> None:
    figure = figures.error_budget(budget())
    left, right = figure.axes
    assert [label.get_text() for label in left.get_yticklabels()] == ["none", "latency", "all"]
    bottom, top = left.get_ylim()
    assert bottom > top  # the first source on top
    assert left.get_xlim()[0] == right.get_xlim()[0] == 0


def test_latency_fit_prints_a_smaller_misfit_after_the_shift() -> None:
    figure = EVERY["latency_fit"]()
    before, after = (float(ax.get_title(loc="left").split("misfit ")[1].split()[0]) for ax in figure.axes)
    assert after < 0.01 < 0.15 < before
    assert "268 ms" in texts(figure)


# ---------------------------------------------------------------------------------------------------------- refusals


EMPTY: dict[str, Callable[[], Figure]] = {
    "empty mask": lambda: figures.ct_slice(
        volumes()[0], volumes()[1].with_values(np.full_like(volumes()[1].values, -1))
    ),
    "mask of another grid": lambda: figures.ct_slice(
        volumes()[0], Volume(volumes()[1].values, np.array([1.0, 1.0, 1.0]))
    ),
    "place outside": lambda: figures.ct_slice(*volumes(), at_mm=(500.0, 0.0, 0.0)),
    "no subjects": lambda: figures.anatomy_overview({}),
    "no views": lambda: figures.coarse_steps({}),
    "no points": lambda: figures.coarse_overlay(np.zeros((0, 3)), POINTS, POINTS),
    "no histories": lambda: figures.som_progress({}),
    "empty history": lambda: figures.som_progress({"CT": ()}),
    "no methods": lambda: figures.registration_grid({}, POINTS),
    "no target": lambda: figures.registration_grid({"icp": POINTS}, np.zeros((0, 3))),
    "no paths": lambda: figures.transferred_path(POINTS, TRUTH, {}),
    "unpaired": lambda: figures.transferred_path(POINTS, TRUTH, {"icp": TRUTH.points[:3]}),
    "empty metrics": lambda: figures.waypoint_boxes(metrics().iloc[:0]),
    "unknown metric": lambda: figures.hd_bars(metrics(), "hd99"),
    "two datasets": lambda: figures.hd_bars(pd.concat([metrics(), metrics().assign(dataset="open")])),
    "missing column": lambda: figures.hd_bars(metrics().drop(columns="status")),
    "only failures": lambda: figures.waypoint_boxes(failing()[lambda t: t["metric"] == "case"]),
    "empty choices": lambda: figures.sensitivity(choices().iloc[:0]),
    "no published option": lambda: figures.sensitivity(choices()[lambda t: t["role"] != "paper"]),
    "nothing paired": lambda: figures.sensitivity(choices()[lambda t: (t["role"] == "paper") ^ (t["case"] == "ct1")]),
    "budget without paths": lambda: figures.error_budget(budget()[lambda t: t["metric"] != "waypoint_error"]),
    "untracked": lambda: figures.sweep_in_space(np.full((5, 3), np.nan), CLOUD),
    "no frame": lambda: figures.frame_with_mask(np.zeros((0, 4)), (0.2, 0.2)),
    "frame of another size": lambda: figures.frame_with_mask(np.ones((4, 4)), (0.2, 0.2), np.ones((4, 5))),
    "no depths": lambda: figures.latency_fit([np.nan] * 3, [0, 1, 2], [0, 1], [0, 1], 0.1),
}


@pytest.mark.parametrize("name", EMPTY)
def test_nothing_to_draw_is_refused(name: str) -> None:
    with pytest.raises(StudyError, match="expected"):
        EMPTY[name]()
