"""The page and the views: what all figures draw with.

All views are drawn in chest coordinates: x to the patient's left, y up, z to the front, mm. Seen from the front, the
patient's right is therefore on the viewer's left.
"""

from __future__ import annotations

import io
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike
from PIL import Image

from study.errors import StudyError
from study.figures.style import DARK, GREY, LEVEL_COLOUR, PART_COLOUR
from study.geometry.points import nearest
from study.types import CARTILAGES, Floats, Ints, Part, RigidTransform, as_points

__all__ = ["T_RAS_CHEST", "StudyFigure", "picture_files", "png", "svg"]

DPI, WIDTH_IN = 150, 11.0
TALLEST_IN = 9.3  # 1,395 pixels: a figure is seen whole on a screen
SHOWN_DPI = 90  # 990 pixels: the width of a notebook's cell; the others are for large screens and print
MAX_DOTS = 5000  # more dots of a cloud only make the file larger

# RAS+ to chest coordinates, for what is given in no other frame.
T_RAS_CHEST = RigidTransform(np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]))

View = Literal["front", "side"]


class StudyFigure(Figure):
    """A figure that a notebook shows by itself, at its own resolution, the same bytes every time."""

    def _repr_png_(self) -> tuple[bytes, dict[str, int]]:
        wide, tall = self.get_size_inches() * SHOWN_DPI
        return png(self), {"width": round(wide), "height": round(tall)}


def png(figure: Figure) -> bytes:
    """A figure as PNG of 256 colours, a third of the full size; the same figure gives the same bytes.

    The most frequent colours stay exact, so flat areas do; the others go to the nearest of a palette made for them.
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    pixels = np.asarray(Image.open(buffer).convert("RGB"))
    packed, place, counts = np.unique(
        pixels.reshape(-1, 3) @ np.array([65536, 256, 1]), return_inverse=True, return_counts=True
    )
    colours = np.stack([packed >> 16, packed >> 8 & 255, packed & 255], axis=-1)
    by_count = np.argsort(-counts, kind="stable")
    palette, others = colours[by_count[:128]], colours[by_count[128:]]
    if len(others):
        made = Image.fromarray(others[None].astype(np.uint8)).quantize(128, Image.Quantize.MAXCOVERAGE)
        palette = np.concatenate([palette, np.array(made.getpalette() or []).reshape(-1, 3)])
    _, index = nearest(colours, palette)  # Pillow's own search takes near colours for equal
    image = Image.fromarray(index[place].reshape(pixels.shape[:2]).astype(np.uint8), mode="P")
    image.putpalette(palette.astype(np.uint8).tobytes())
    buffer = io.BytesIO()
    image.save(buffer, format="png", optimize=True, dpi=(figure.dpi, figure.dpi))
    return buffer.getvalue()


def svg(figure: Figure) -> bytes:
    """A figure as SVG, for print; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    with rc_context({"svg.hashsalt": "study"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def picture_files(drawn: Mapping[str, Figure]) -> dict[str, bytes]:
    """Each figure as the files that are kept of it, PNG and SVG, by file name."""
    return {
        f"{name}.{kind}": made(figure) for name, figure in drawn.items() for kind, made in (("png", png), ("svg", svg))
    }


def new_figure(height_in: float, title: str) -> StudyFigure:
    """A figure of the notebook's width, no taller than a screen."""
    figure = StudyFigure(figsize=(WIDTH_IN, min(height_in, TALLEST_IN)), dpi=DPI, layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=12)
    return figure


def require(things: Any, what: str) -> None:
    """Refuse to draw nothing.

    Raises:
        StudyError: ``things`` has no length.
    """
    if len(things) == 0:
        raise StudyError(f"expected {what} to draw, got none; run the step before and check that it succeeded")


def require_columns(df: pd.DataFrame, columns: Sequence[str], what: str) -> None:
    """Refuse a table that lacks a column or has no row.

    Raises:
        StudyError: a column is missing, or there is no row.
    """
    missing = [column for column in columns if column not in df.columns]
    if missing:
        raise StudyError(f"expected a table with {', '.join(columns)}, got none of {', '.join(missing)}; pass {what}")
    require(df, what)


def project(points: ArrayLike, view: View, T_cloud_chest: RigidTransform | None, name: str = "points") -> Floats:
    """(n, 3) mm: across the page, up the page, towards the viewer. The side view is from the patient's right."""
    left, up, front = (T_cloud_chest or T_RAS_CHEST).inverse.apply(as_points(points, name)).T
    return np.column_stack([left, up, front] if view == "front" else [front, up, -left])


def bounds(*seen: Floats, margin_mm: float = 8.0) -> Floats:
    """(2, 2): lower and upper corner of what is on the page."""
    low = np.min([points[:, :2].min(axis=0) for points in seen], axis=0)
    high = np.max([points[:, :2].max(axis=0) for points in seen], axis=0)
    return np.array([low - margin_mm, high + margin_mm])


def look(ax: Axes, view: View, extent: Floats, title: str = "", *, on_dark: bool = False) -> None:
    """Equal aspect, mm axes and the patient's right and left."""
    (x0, y0), (x1, y1) = extent
    ax.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal")
    ax.set_xlabel("to the patient's left (mm)" if view == "front" else "to the front (mm)", fontsize=8)
    ax.set_ylabel("up (mm)", fontsize=8)
    plain(ax, title)
    if view == "front":
        _mark_sides(ax, *(("white", "black") if on_dark else (DARK, "white")))


def plain(ax: Axes, title: str = "") -> None:
    """Small ticks, no box, the title at the left."""
    ax.tick_params(labelsize=8)
    ax.spines[["top", "right"]].set_visible(False)
    ax.set_title(title, fontsize=9.5, loc="left")


def _mark_sides(ax: Axes, colour: str, halo: str) -> None:
    """The patient's right and left, in the lower corners of a front view."""
    for x, letter in ((0.015, "R"), (0.985, "L")):
        align = "left" if letter == "R" else "right"
        style: dict[str, Any] = {"ha": align, "fontsize": 11, "weight": "bold", "color": colour}
        ax.text(
            x, 0.02, letter, transform=ax.transAxes, path_effects=[withStroke(linewidth=2, foreground=halo)], **style
        )


def thin(n: int, most: int = MAX_DOTS) -> Ints:
    """Row numbers of at most ``most`` of ``n`` rows, evenly spaced."""
    return np.arange(n) if n <= most else np.linspace(0, n - 1, most).astype(np.int64)


def dots(ax: Axes, seen: Floats, colours: Any, size: float = 3.0, **style: Any) -> Any:
    """Scatter with the nearest on top; ``colours`` is one colour or a row per point."""
    rows = thin(len(seen))
    rows = rows[np.argsort(seen[rows, 2], kind="stable")]
    if np.ndim(colours) > 0 and len(colours) == len(seen):
        colours = np.asarray(colours)[rows]
    return ax.scatter(seen[rows, 0], seen[rows, 1], s=size, c=colours, linewidths=0, rasterized=True, **style)


def draw_surface(ax: Axes, seen: Floats, faces: Ints, colours: Floats) -> None:
    """The triangles that face the viewer, lit from there; ``colours`` (v, 3) by vertex."""
    corners = seen[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lit = normals[:, 2] / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    front = np.flatnonzero(lit > 0)
    front = front[np.argsort(corners[front, :, 2].mean(axis=1), kind="stable")]
    shaded = colours[faces[front, 0]] * (0.45 + 0.55 * lit[front, None])
    # Edges in the colour of the face close the hairlines between triangles.
    triangles = PolyCollection(list(corners[front, :, :2]), facecolors=shaded, edgecolors=shaded, linewidths=0.3)
    triangles.set_rasterized(True)
    ax.add_collection(triangles)


def name_parts(ax: Axes, seen: Floats, parts: Ints) -> None:
    """R2 to L5 at the lateral end of each cartilage."""
    for part in CARTILAGES:
        branch = seen[parts == part]
        if len(branch):
            outwards = np.sign(branch[:, 0].mean() - seen[:, 0].mean())
            ends = branch[np.argsort(outwards * branch[:, 0])[-max(1, len(branch) // 10) :]]
            x, y = ends[:, 0].mean() + 9 * outwards, ends[:, 1].mean()
            halo = [withStroke(linewidth=2.5, foreground="white")]
            text = f"{part.side[0].upper()}{part.level}"
            ax.text(x, y, text, ha="center", va="center", fontsize=9, weight="bold", path_effects=halo)


def below(figure: Figure, handles: Sequence[Any], columns: int) -> None:
    """A legend below the panels."""
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, fontsize=8, frameon=False)


def part_legend(figure: Figure, extra: Sequence[Any] = (), shown: Collection[Part] = tuple(Part)) -> None:
    """Levels and sides below the figure, those of the parts ``shown``."""
    handles = [Patch(color=GREY, label="sternum")] if Part.STERNUM in shown else []
    levels = {part.level for part in shown if part in CARTILAGES}
    handles += [Patch(color=LEVEL_COLOUR[level], label=f"cartilage {level}") for level in sorted(levels)]
    left = [part for part in CARTILAGES if part in shown and part.side == "left"]
    handles += [Patch(color=PART_COLOUR[part], label="patient's left: lighter") for part in left[:1]]
    below(figure, [*handles, *extra], 6 if not extra else 5)
