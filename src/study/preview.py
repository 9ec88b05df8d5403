"""What a notebook shows of a cloud: a few lines and one small picture, as HTML.

It stands below the types it is drawn for and takes arrays only. The figures of the study are in `study.figures`.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping
from html import escape
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

WIDTH_PX = 220
MARGIN_PX = 4
MAX_HEIGHT_PX = 330
DOT_PX = 2
N_SHADES = 12  # few colours keep the picture small

Points = NDArray[np.float64]
Numbers = NDArray[Any]

_WHITE, _PALE, _STERNUM = (255, 255, 255), (200, 200, 200), (140, 140, 140)
_LEVELS = ((0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167))  # Okabe and Ito: ribs 2-5, as in the figures
_LEFT = tuple(tuple(round(c + 0.38 * (255 - c)) for c in level) for level in _LEVELS)  # lighter than the right
_LOW, _HIGH = np.array([225, 225, 225]), np.array([178, 24, 43])  # unmoved to moved most


def by_part(points: Points, parts: Numbers | None = None) -> bytes:
    """Picture of ``points`` (n, 3) mm, coloured by ``parts`` (n,) of `study.types.Part`, else grey; PNG."""
    palette = np.array([_PALE, _STERNUM, *_LEVELS, *_LEFT])
    colour = np.ones(len(points), dtype=np.int64) if parts is None else np.clip(parts + 1, 0, len(palette) - 1)
    return _picture(points, colour, palette)


def by_size(points: Points, sizes: Numbers) -> bytes:
    """Picture of ``points`` (n, 3) mm, from grey where ``sizes`` (n,) is 0 to red where it is largest; PNG."""
    share = sizes / max(float(sizes.max()), 1e-9)
    palette = _LOW + np.linspace(0, 1, N_SHADES)[:, None] * (_HIGH - _LOW)
    return _picture(points, np.minimum(share * N_SHADES, N_SHADES - 1).astype(np.int64), palette.round())


def card(title: str, lines: Mapping[str, str], png: bytes) -> str:
    """HTML of a picture beside its lines; every word is escaped."""
    rows = "".join(f"<div><i>{escape(name)}</i>: {escape(value)}</div>" for name, value in lines.items())
    picture = f'<img width="{WIDTH_PX}" alt="{escape(title)}" src="data:image/png;base64,{b64encode(png).decode()}">'
    words = f"<div><b>{escape(title)}</b>{rows}</div>"
    return f'<div style="display:flex;gap:1em;align-items:center">{picture}{words}</div>'


def _picture(points: Points, colour: Numbers, palette: Numbers) -> bytes:
    """PNG of ``points`` seen along the axis of least variance, ``palette[colour]`` each, near ones over far ones."""
    from PIL import Image  # only notebooks draw

    local = (points - points.mean(axis=0)) @ _view(points).T
    order = np.argsort(local[:, 2], kind="stable")
    across, colour = local[order, :2] * [1, -1], colour[order]  # pixel rows count downwards
    low, extent = across.min(axis=0), np.ptp(across, axis=0)
    space = np.array([WIDTH_PX, MAX_HEIGHT_PX]) - 2 * MARGIN_PX - DOT_PX
    scale = float((space / np.maximum(extent, 1e-9)).min())  # pixels per mm
    pixels = np.floor((across - low) * scale).astype(np.int64) + MARGIN_PX
    pixels[:, 0] += int((space[0] - extent[0] * scale) / 2)
    height = int(extent[1] * scale) + 2 * MARGIN_PX + DOT_PX
    canvas = np.zeros((height, WIDTH_PX), dtype=np.uint8)
    dot = np.arange(DOT_PX)
    # Point by point, all pixels of a dot: a later, nearer point covers an earlier one.
    rows, columns = pixels[:, 1, None, None] + dot[:, None], pixels[:, 0, None, None] + dot
    canvas[rows, columns] = colour[:, None, None] + 1  # 0 is the paper
    image = Image.frombytes("P", (WIDTH_PX, height), canvas.tobytes())
    image.putpalette(np.vstack([_WHITE, palette]).astype(np.uint8).tobytes())
    out = BytesIO()
    image.save(out, "PNG", optimize=True)
    return out.getvalue()


def _view(points: Points) -> Points:
    """Rows right, up and towards the viewer: patients in RAS+ are seen from the front, head up."""
    towards = np.linalg.eigh(np.cov((points - points.mean(axis=0)).T))[1][:, 0]
    towards = towards * (1.0 if towards[1] >= 0 else -1.0)
    head = np.array([0.0, 0.0, 1.0]) if abs(towards[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    up = head - (head @ towards) * towards
    up /= np.linalg.norm(up)
    return np.array([np.cross(up, towards), up, towards])
