"""What each choice of the skeleton graph is worth: the published method with one thing changed at a time.

`DEVIATIONS.md` has a row for each choice. Where the paper is silent, the published option is this study's, or the
authors' code's for the start and the shape of the neighbourhood.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import pandas as pd

from study.errors import StudyError
from study.evaluation.judgement import Judgement
from study.evaluation.pair import Pair
from study.evaluation.statistics import population_sd
from study.methods import METHODS
from study.methods.skeleton_graph import SkeletonGraphMethod
from study.methods.visible_surface import VisibleSurface
from study.pipeline import register_aligned
from study.registration import Method, Registration
from study.seeds import named_rng
from study.skeleton.template import N_NODES

Role = Literal["paper", "authors", "alternative", "yardstick"]
PROTOCOL, TRUE_IN_PLANE = "protocol", "truth, in the feature plane"  # who judges an option
RIGID = "all nodes: rigid"
AS_AUTHORS = "skeleton_graph_authors"
FIRST_DRAW = "first"
MORE_DRAWS = ("second", "third", "fourth")  # of the yardstick


@dataclass(frozen=True)
class Option:
    """One way to make one choice.

    Attributes:
        choice: what is chosen.
        option: the way.
        role: ``paper`` as published, ``authors`` as their public code does, an ``alternative``, or the ``yardstick``:
            the published method with other random draws.
        method: what then registers.
        radius_mm: sphere of the path transfer.
    """

    choice: str
    option: str
    role: Role
    method: Method
    radius_mm: float


def options(method: SkeletonGraphMethod, radius_mm: float = 20.0) -> list[Option]:
    """Every choice of a skeleton graph, in the order of the paper: the published option first, then the others.

    Args:
        method: the method as published; every other option changes it.
        radius_mm: sphere of the path transfer (sec. III-D).
    """
    return [
        *_of_the_map(method, radius_mm),
        *_of_the_warp(method, radius_mm),
        *_of_the_path(method, radius_mm),
        *_of_it_all(method, radius_mm),
    ]


def _choice(published: Option, *others: tuple[str, Role, Method]) -> list[Option]:
    """The options of one choice: the published one, then what else could register."""
    named = (replace(published, option=option, role=role, method=method) for option, role, method in others)
    return [published, *named]


def _maps(
    method: SkeletonGraphMethod, ct: Mapping[str, Any] | None = None, us: Mapping[str, Any] | None = None, **both: Any
) -> SkeletonGraphMethod:
    """The method with another schedule of its CT map, its US map, or both."""
    ct_som, us_som = replace(method.ct_som, **both, **(ct or {})), replace(method.us_som, **both, **(us or {}))
    return replace(method, ct_som=ct_som, us_som=us_som)


def _of_the_map(method: SkeletonGraphMethod, radius_mm: float) -> list[Option]:
    """Choices of the map (sec. III-B, Eq. 2), after the yardstick."""
    paper = partial(Option, role="paper", method=method, radius_mm=radius_mm)
    som, authors = method.ct_som, SkeletonGraphMethod.as_authors()
    epochs = {
        name: {"epochs": theirs.epochs, "samples": theirs.samples}
        for name, theirs in (("ct", authors.ct_som), ("us", authors.us_som))
    }
    return [
        *_choice(paper("random draws", "one seed"), ("other seeds", "yardstick", method)),
        *_choice(
            paper("learning rate (Eq. 2)", som.rate_schedule),
            ("compounding", "authors", _maps(method, rate_schedule="compounding")),
            ("linear to 0", "alternative", _maps(method, rate_schedule="linear")),
        ),
        *_choice(
            paper("epochs × samples (paper silent)", f"{som.epochs} × {som.samples}"),
            ("5000 × 500, US 3000 × 130", "authors", _maps(method, **epochs)),
            (f"{som.epochs // 5} × {som.samples}", "alternative", _maps(method, epochs=som.epochs // 5)),
        ),
        *_choice(
            paper("start of the neighbourhood (paper silent)", f"{som.radius:g} hops"),
            ("2 hops", "alternative", _maps(method, radius=2.0)),
            ("3 hops", "alternative", _maps(method, radius=3.0)),
        ),
        *_choice(
            paper("fall of the neighbourhood (paper silent)", som.radius_schedule),
            ("compounding radius", "authors", _maps(method, radius_schedule="compounding")),
        ),
        *_choice(
            paper("one-way edges in the first epochs", f"{som.pretrain_epochs} epochs"),
            ("of the CT map only", "authors", _maps(method, us={"pretrain_epochs": 0})),
            ("none", "alternative", _maps(method, pretrain_epochs=0)),
        ),
        *_choice(
            paper("nodes that may win a point", som.winners),
            ("of the point's own part", "alternative", _maps(method, winners="own_part")),
        ),
    ]


def _of_the_warp(method: SkeletonGraphMethod, radius_mm: float) -> list[Option]:
    """Choices of the warp (sec. III-C, Eqs. 3 and 4)."""
    paper = partial(Option, role="paper", method=method, radius_mm=radius_mm)
    return [
        *_choice(
            paper("nodes of a local transform (Eq. 3)", f"{method.n_reg} {method.neighbours}"),
            ("within 3 hops", "authors", replace(method, n_reg=3, neighbours="hops")),
            ("16 nodes", "alternative", replace(method, n_reg=16)),
            (RIGID, "alternative", replace(method, n_reg=N_NODES)),
        ),
        *_choice(
            paper("weights of the blend (Eq. 4)", method.blend_weights),
            ("inverse distance", "alternative", replace(method, blend_weights="inverse_distance")),
        ),
        *_choice(
            paper("N of the blend (paper silent)", f"{method.blend_k} nodes"),
            ("1 node", "alternative", replace(method, blend_k=1)),
            ("8 nodes", "alternative", replace(method, blend_k=8)),
        ),
    ]


def _of_the_path(method: SkeletonGraphMethod, radius_mm: float) -> list[Option]:
    """Choices of the path transfer (sec. III-D)."""
    published = Option("sphere of path transfer (§III-D)", f"{radius_mm:g} mm", "paper", method, radius_mm)
    wider = partial(replace, published, role="alternative")
    return [published, wider(option="30 mm", radius_mm=30.0), wider(option="40 mm", radius_mm=40.0)]


def _of_it_all(method: SkeletonGraphMethod, radius_mm: float) -> list[Option]:
    """Which surface is registered, and several choices at once."""
    paper = partial(Option, role="paper", method=method, radius_mm=radius_mm)
    tuned = "skeleton_graph_tuned"
    return [
        *_choice(
            paper("surface of the CT that is registered", "all of it"),
            ("what a probe can see", "alternative", VisibleSurface(method)),
        ),
        *_choice(
            paper("all of it together", "as published"),
            (AS_AUTHORS, "authors", METHODS[AS_AUTHORS]),
            (tuned, "alternative", METHODS[tuned]),
        ),
    ]


def ablate(pairs: Sequence[Pair], options: Sequence[Option], seed: int) -> pd.DataFrame:
    """Mean waypoint errors of every option on every pair.

    Options that differ in the path transfer only share their registration, and so their random draws.

    Args:
        pairs: judged by the paper's protocol, and by the truth where it is known.
        options: as `options` lists them.
        seed: of the draws.

    Returns:
        a row for each option, pair, draw and judge: ``choice``, ``option``, ``role``, ``case``, ``judge``, ``value``
        (mm).

    Raises:
        StudyError: no pair or no option, or a method that fails.
    """
    if not (pairs and options):
        raise StudyError(f"expected a pair and an option or more, got {len(pairs)} and {len(options)}; list some")
    known: dict[tuple[str, Method, str], Registration] = {}
    rows: list[dict[str, Any]] = []
    for option in options:
        for pair in pairs:
            what = {"choice": option.choice, "option": option.option, "role": option.role}
            what["case"] = f"{pair.source} to {pair.target}"
            for draw in MORE_DRAWS if option.role == "yardstick" else (FIRST_DRAW,):
                key = (pair.name, option.method, draw)
                if key not in known:
                    rng = named_rng(seed, f"{pair.name}/{draw}")
                    known[key] = register_aligned(pair.alignment, option.method, rng)
                errors = _errors_mm(Judgement(pair, known[key], option.radius_mm))
                rows += [{**what, "judge": judge, "value": value} for judge, value in errors.items()]
    return pd.DataFrame(rows)


def _errors_mm(judgement: Judgement) -> dict[str, float]:
    """Mean waypoint error by the protocol and, where it is known, by the truth in the feature plane."""
    errors = {PROTOCOL: float(judgement.protocol_errors_mm().mean())}
    if judgement.pair.has_truth:
        errors[TRUE_IN_PLANE] = float(judgement.true_waypoint_errors_mm(in_plane=True).mean())
    return errors


def changes(table: pd.DataFrame) -> pd.DataFrame:
    """What each option changes: `ablate`'s rows with ``published``, the published value on that pair, and ``change``.

    The published rows stay, with a change of 0 mm.
    """
    base = table[table["role"] == "paper"].set_index(["choice", "judge", "case"])["value"]
    beside = table.join(base.rename("published"), on=["choice", "judge", "case"])
    return beside.assign(change=beside["value"] - beside["published"])


def beyond_luck(changed: pd.DataFrame) -> tuple[tuple[float, float], pd.Series]:
    """The range that other draws span, mean ± SD over pairs and draws, and the options whose mean change leaves it.

    Args:
        changed: rows of `changes` under one judge.

    Returns:
        the range (mm), and by choice and option the mean change (mm) where it lies outside.

    Raises:
        StudyError: rows of several judges, or no yardstick among them.
    """
    judges = list(changed["judge"].unique())
    draws = changed.loc[changed["role"] == "yardstick", "change"]
    if len(judges) != 1 or draws.empty:
        raise StudyError(
            f"expected rows of one judge with a yardstick, got {len(draws)} rows of a yardstick and the judges "
            f"{', '.join(judges) or 'none'}; select one judge and keep the yardstick's option"
        )
    low, high = float(draws.mean()) - population_sd(draws), float(draws.mean()) + population_sd(draws)
    others = changed[~changed["role"].isin(["paper", "yardstick"])]
    mean = others.groupby(["choice", "option"], sort=False)["change"].mean()
    return (low, high), mean[(mean < low) | (mean > high)]
