"""Bad input of every kind: its own clear error, never a plausible wrong answer."""

import ast
import re
from pathlib import Path

import numpy as np
import pytest

import study
from study import register_pair
from study.errors import StudyError
from study.types import Part

RNG = np.random.default_rng(0)
BALL = 100 * RNG.normal(size=(3000, 3)) / 3
ANGLE = RNG.uniform(0, 2 * np.pi, 3000)
DISC = 80 * np.sqrt(RNG.random(3000))[:, None] * np.column_stack([np.cos(ANGLE), np.sin(ANGLE), 0 * ANGLE])
PLATE = RNG.uniform([-90, -60], [90, 60], (3000, 2))
VAULT = np.column_stack([PLATE, -(PLATE**2).sum(axis=1) / 400])  # it bulges, but nothing leaves it


def with_bad_row(points: np.ndarray, value: float) -> np.ndarray:
    bad = np.array(points)
    bad[7, 1] = value
    return bad


BAD = {
    "nan": (lambda p: with_bad_row(p, np.nan), r"expected finite numbers, got 1 rows"),
    "infinite": (lambda p: with_bad_row(p, np.inf), r"expected finite numbers, got 1 rows"),
    "empty": (lambda p: p[:0], r"expected at least \d+ points, got 0"),
    "two columns": (lambda p: p[:, :2], r"expected shape \(n, 3\), got \(4000, 2\)"),
    "transposed": (lambda p: p.T, r"expected shape \(n, 3\), got \(3, 4000\)"),
    "ragged": (lambda p: [[1, 2, 3], [1, 2]], r"expected numbers of shape \(n, 3\)"),
    "none": (lambda p: None, r"expected shape \(n, 3\), got \(\)"),
    "words": (lambda p: [["x", "y", "z"]] * 60, r"expected numbers of shape \(n, 3\)"),
    "five points": (lambda p: p[:5], r"expected at least 50 points, got 5"),
    "metres": (lambda p: p / 1000, r"expected a chest of 20-2000 mm across, got 0\.\d+ mm; metres\? multiply by 1000"),
    "micrometres": (lambda p: p * 1000, r"expected a chest of 20-2000 mm across, got .*; check the units"),
    "one place": (lambda p: np.repeat(p[:1], 100, axis=0), r"expected a chest of 20-2000 mm across, got 0 mm"),
    "ball": (lambda p: BALL, r"expected a chest wall spread over a plane, got principal spreads"),
    "line": (lambda p: p[:, :1] * [1.0, 0, 0], r"expected a chest wall spread over a plane, got principal spreads"),
    "flat disc": (lambda p: DISC, r"expected (4 separate|four|open)"),
    "vault": (lambda p: VAULT, r"expected (4 separate|four|open)"),
    "half a chest": (lambda p: p[p[:, 0] > np.median(p[:, 0])], r"no sternum found|expected (4 separate|four) cartil"),
    "upper half": (lambda p: p[p[:, 2] > np.median(p[:, 2])], r"no sternum found|expected (4 separate|four) cartil"),
    "half the size": (lambda p: p / 2, r"no sternum found|expected (4 separate|four) cartilages"),
    "flattened": (lambda p: p * [1, 0, 1], r"expected cartilages that arch .* got 0\.00 mm"),
}


@pytest.mark.parametrize("kind", list(BAD))
def test_bad_ct_is_an_error_that_names_the_ct(kind, ct_clouds, us_cloud):
    spoil, message = BAD[kind]
    with pytest.raises(StudyError, match=message) as info:
        register_pair(spoil(ct_clouds["ct1"].points), us_cloud.points, "coarse")
    assert re.search(r"\bct\b", str(info.value))


@pytest.mark.parametrize("kind", ["nan", "five points", "metres", "ball"])
def test_bad_us_is_an_error_that_names_the_us(kind, ct_clouds, us_cloud):
    spoil, message = BAD[kind]
    with pytest.raises(StudyError, match=message) as info:
        register_pair(ct_clouds["ct1"].points, spoil(us_cloud.points), "coarse")
    assert re.search(r"\bus\b", str(info.value))


@pytest.mark.parametrize("part", [Part.STERNUM, Part.LEFT_5])
def test_a_torn_chest_is_an_error(part, ct_clouds, us_cloud):
    torn = us_cloud.points[us_cloud.parts != part]
    with pytest.raises(StudyError, match=r"us.*(best overlap|cartilages)"):
        register_pair(ct_clouds["ct1"].points, torn, "coarse")


def test_a_mirrored_cloud_is_registered_without_a_reflection(ct_clouds, us_cloud):
    mirrored = register_pair(ct_clouds["ct1"].points * [-1, 1, 1], us_cloud.points, "icp")
    assert np.linalg.det(mirrored.T_us_ct.rotation) == pytest.approx(1)
    assert mirrored.warped == pytest.approx(mirrored.T_us_ct.apply(mirrored.source), abs=1e-9)


def test_unknown_methods_and_seeds_are_errors(ct_clouds, us_cloud):
    ct, us = ct_clouds["ct1"].points, us_cloud.points
    with pytest.raises(StudyError, match=r"expected a method among .* got 'magic'"):
        register_pair(ct, us, "magic")
    with pytest.raises(StudyError, match="expected a seed of 0 or more, got -3"):
        register_pair(ct, us, "coarse", seed=-3)


def test_every_message_says_what_was_expected_and_what_came():
    """Read from the source, so that a new message is held to it too."""
    folder = Path(study.__file__).parent
    alone = ("types", "params", "seeds", "registration", "pipeline")
    rooms = ("geometry", "alignment", "skeleton", "methods")
    files = [folder / f"{name}.py" for name in alone]
    files += [file for room in rooms for file in sorted((folder / room).glob("*.py"))]
    messages = []
    for file in files:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "StudyError":
                words = [part.value for part in ast.walk(node) if isinstance(part, ast.Constant)]
                messages.append(f"{file.relative_to(folder)}: " + " ".join(str(word) for word in words))
    assert len(messages) > 60
    for message in messages:
        assert re.search(r"\b(expected|need)\b", message), message
        assert re.search(r"\b(got|best overlap)\b", message), message
