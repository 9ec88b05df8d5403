"""Colours, markers and labels: rib levels, clouds and methods look the same in every figure.

Rib levels have one colour each, the patient's left lighter than the right. Methods have one colour and marker each: as
tuned solid, as shipped lighter; a dark outline where they see the visible surface only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from zlib import crc32

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Colormap, to_rgb

from study.evaluation.pair import TRUTH
from study.types import CARTILAGES, Floats, Ints, Part

__all__ = ["METHOD_STYLE", "PART_COLOUR", "SIMULATED", "MethodStyle", "method_style"]

Colour = tuple[float, float, float]

LEVEL_COLOUR = {2: "#0072B2", 3: "#E69F00", 4: "#009E73", 5: "#CC79A7"}  # Okabe and Ito
GREY, DARK, PALE = "#8c8c8c", "#333333", "#c8c8c8"
DATASET_STYLE = (("#0077BB", "o"), ("#CC3311", "s"), ("#009988", "^"), ("#EE7733", "D"))  # Paul Tol's vibrant scheme
CT_COLOUR, US_COLOUR = "#D55E00", "#0072B2"

# Where numbers come from, for titles and legends.
SIMULATED = "simulated patient"
PAPER = "paper, other data"


def lighter(colour: str, share: float) -> Colour:
    """A colour with a share of white, 0-1."""
    red, green, blue = (channel + share * (1 - channel) for channel in to_rgb(colour))
    return red, green, blue


PART_COLOUR: Mapping[Part, Colour] = {
    Part.UNKNOWN: to_rgb(PALE),
    Part.STERNUM: to_rgb(GREY),
    **{part: lighter(LEVEL_COLOUR[part.level], 0.0 if part.side == "right" else 0.38) for part in CARTILAGES},
}


def part_colours(parts: Ints | None, n: int) -> Floats:
    """(n, 3) colours of points; pale where there are no parts."""
    parts = np.full(n, int(Part.UNKNOWN)) if parts is None else parts
    table = np.array([PART_COLOUR[part] for part in Part])  # UNKNOWN is first, at -1
    return table[np.asarray(parts) + 1]


def steps(name: str) -> Colormap:
    """A colour map in 20 even steps: they survive `png` exactly, on the dots as on the colour bar."""
    return colormaps[name].resampled(20)


@dataclass(frozen=True)
class MethodStyle:
    """How a method is drawn in every figure.

    Attributes:
        label: for legends.
        colour: of lines and fills.
        marker: of points.
        tuned: tuned methods are solid, the others lighter.
        visible: methods that register the visible surface only have a dark outline, the others one of their colour.
    """

    label: str
    colour: str
    marker: str
    tuned: bool
    visible: bool = False

    @property
    def edge(self) -> str:
        """Outline of boxes and markers."""
        return "#000000" if self.visible else self.colour

    @property
    def face(self) -> Colour:
        """Fill of boxes and markers."""
        return lighter(self.colour, 0.0 if self.tuned else 0.62)


_CELLS = {"_tuned_whole": (True, False), "_tuned": (True, True), "_visible": (False, True)}  # tuned, visible


def _styles(name: str, label: str, colour: str, marker: str) -> dict[str, MethodStyle]:
    """The four cells of a method: parameters, shipped or tuned, times surface, whole or visible."""
    styles = {name: MethodStyle(label, colour, marker, tuned=False)}
    for suffix, (tuned, visible) in _CELLS.items():
        styles[name + suffix] = MethodStyle(label + suffix.replace("_", ", "), colour, marker, tuned, visible)
    return styles


# Paul Tol's vibrant scheme, safe for the colour-blind. A method that is not listed gets a style by its name.
METHOD_STYLE: Mapping[str, MethodStyle] = {
    "coarse": MethodStyle("Coarse alignment", "#777777", "v", tuned=False),
    **_styles("icp", "ICP", "#0077BB", "o"),
    **_styles("nonrigid_icp", "Non-rigid ICP", "#EE7733", "s"),
    **_styles("cpd", "CPD", "#009988", "^"),
    **_styles("bcpd", "Bayesian CPD", "#AA4499", "<"),
    **_styles("skeleton_graph", "Skeleton graph", "#CC3311", "D"),
    "skeleton_graph_authors": MethodStyle("Skeleton graph, authors' code", "#882255", "d", tuned=False),
    "skeleton_graph_repaired": MethodStyle("Skeleton graph, repaired", "#CC3311", "H", tuned=True, visible=True),
    "gaussian_process": MethodStyle("Gaussian process", "#009900", "h", tuned=True, visible=True),
    # No method: the known deformation, judged like one.
    TRUTH: MethodStyle("Perfect (truth)", "#222222", "*", tuned=True),
}


# For methods that are not listed: neither these colours nor these markers are in the list.
_OTHER_COLOURS, _OTHER_MARKERS = ("#EE3377", "#33BBEE", "#332288", "#AA9900"), (">", "P", "X", "p")


def method_style(name: str) -> MethodStyle:
    """The style of any method; a new one needs no entry in `METHOD_STYLE`.

    A name that is not listed always gets the same colour and marker, which no listed method has, and is its own label;
    endings such as ``_tuned`` are drawn as they are for the listed ones.
    """
    if name in METHOD_STYLE:
        return METHOD_STYLE[name]
    base = name.removesuffix(next(filter(name.endswith, _CELLS), ""))
    pick = crc32(base.encode())
    colour, marker = _OTHER_COLOURS[pick % 4], _OTHER_MARKERS[pick // 4 % 4]
    return _styles(base, base.replace("_", " "), colour, marker)[name]
