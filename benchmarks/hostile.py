"""What hostile input does to `register_pair`: right, refused, warned, or wrong in silence, by class.

    python benchmarks/hostile.py [--cases 15] [--seeds 401 410] [--jobs 2] [--rows FILE.csv]

Every case is a pair of development phantoms (cohort seeds that no data set reports) in random poses, disturbed in one
way, registered by the default method. The truth is known, so each answer is one of: right (mean true waypoint error up
to 6 mm and none above 20 mm), refused (a `StudyError`), warned (wrong, and said so), wrong in silence. A right answer
with a warning is counted beside. Classes marked * can't be told from points alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
from joblib import Parallel, delayed
from skimage.measure import marching_cubes

from study import phantom
from study.errors import StudyError
from study.evaluation.distances import point_errors_mm
from study.phantom.surface import onto_surface
from study.phantom.wall import BONE, COURSES, centrelines, sternum_distance, tube_distance, wall_distance
from study.pipeline import register_pair
from study.seeds import named_rng
from study.types import Bools, Floats, RigidTransform

RIGHT_MEAN_MM, RIGHT_WORST_MM, FAR_MM = 6.0, 20.0, 10.0
SPACING_MM = 1.75
CROP_Z = (-78.0, 8.0)  # canonical heights of the sternum's cut
FRONT = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class Wall:
    """The whole canonical front of the chest, by triangle: corners, normal, sternum or not, level, bone or not."""

    corners: Floats
    normals: Floats
    sternum: Bools
    level: np.ndarray
    bone: Bools
    middle: Floats


@lru_cache(maxsize=1)
def wall() -> Wall:
    low, high = np.array([-150.0, -9.0, -175.0]), np.array([150.0, 9.0, 75.0])
    axes = [np.arange(a, b, SPACING_MM) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    field = wall_distance(grid.reshape(-1, 3)).reshape(grid.shape[:3])
    vertices, faces, normals, _ = marching_cubes(field, 0.0, spacing=(SPACING_MM,) * 3)
    vertices = onto_surface(vertices + low)
    corners = vertices[faces]
    middle = corners.mean(axis=1)
    tube, index = tube_distance(middle)
    lines = centrelines()
    return Wall(
        corners,
        -normals[faces].mean(axis=1) if normals[:, 1] @ vertices[:, 1] < 0 else normals[faces].mean(axis=1),
        sternum_distance(middle) <= tube,
        lines.level[index],
        lines.tissue[index] == BONE,
        middle,
    )


def whole(
    levels: tuple[int, ...] = (2, 3, 4, 5), *, bone_mm: float = 0.0, sternum: tuple[float, float] = CROP_Z
) -> Bools:
    """Which triangles belong to a crop: cartilages of some levels, so much of their ribs, some of the sternum."""
    w = wall()
    _, index = tube_distance(w.middle)
    arc = centrelines().arc[index]
    length = np.array([0.0, *[COURSES[level][0] for level in range(1, 9)]])[w.level]
    on_tube = ~w.sternum & np.isin(w.level, levels) & (~w.bone | (arc < length + bone_mm))
    z = w.middle[:, 2]
    return on_tube | (w.sternum & (z > sternum[0]) & (z < sternum[1]))


def sample(who: phantom.SyntheticSubject, n: int, rng: np.random.Generator, keep: Bools, *, front: bool) -> Floats:
    """Points (n, 3) mm, RAS+, uniform by area of the triangles kept, those that face the probe alone where asked."""
    w = wall()
    if front:
        keep = keep & (w.normals[:, 1] > 0.35 * np.linalg.norm(w.normals, axis=1))
    corners = w.corners[keep]
    moved = who.phi.apply(corners.reshape(-1, 3)).reshape(corners.shape)
    area = np.linalg.norm(np.cross(moved[:, 1] - moved[:, 0], moved[:, 2] - moved[:, 0]), axis=1)
    cumulated = np.cumsum(area)
    face = np.searchsorted(cumulated, (np.arange(n) + rng.random(n)) / n * cumulated[-1], side="right")
    weights = rng.dirichlet(np.ones(3), size=n)
    points = np.einsum("nk,nki->ni", weights, corners[np.minimum(face, len(corners) - 1)])
    return np.asarray(who.phi.apply(points))


@dataclass
class Case:
    """A pair as it is given, RAS+ before the poses; waypoints of the CT and where they belong."""

    ct: Floats
    us: Floats
    waypoints: Floats
    goal: Floats
    front: Floats | None = None
    rigid: bool = True  # poses drawn after


class World:
    """One pair of people and the draws of one case."""

    def __init__(self, seed: int, name: str, rng: np.random.Generator) -> None:
        self.source, self.target = phantom.draw_subject(name, seed), phantom.draw_subject("patient", seed)
        self.rng = rng

    def ct(self, n: int = 7000, keep: Bools | None = None) -> Floats:
        return sample(self.source, n, self.rng, whole() if keep is None else keep, front=False)

    def us(self, n: int = 5000, keep: Bools | None = None, noise: float = 0.5, strips: int = 2) -> Floats:
        points = sample(self.target, n, self.rng, whole() if keep is None else keep, front=True)
        for _ in range(strips):
            middle = points[self.rng.integers(len(points))]
            angle, half = self.rng.uniform([0, 2], [np.pi, 4])
            along = np.array([np.cos(angle), 0, np.sin(angle)])
            offset = points - middle
            points = points[(np.abs(offset @ along) > 22) | (np.abs(offset @ [-along[2], 0, along[0]]) > half)]
        return points + self.rng.normal(scale=noise, size=points.shape)

    def case(self, ct: Floats | None = None, us: Floats | None = None, front: Floats | None = None) -> Case:
        path = phantom.waypoints(self.source).points
        goal = phantom.truth_map(self.source, self.target, path)
        return Case(self.ct() if ct is None else ct, self.us() if us is None else us, path, goal, front)

    def canonical(self, points: Floats, who: str) -> Floats:
        return np.asarray((self.source if who == "ct" else self.target).phi.inverse(points))


Maker = Callable[[World], Case]
KINDS: dict[str, Maker] = {}
# A mirror image is a chest; 3-6 and some 1-4 have the sizes of 2-5; a little rib, or 40 % more, is a longer cartilage.
UNDECIDABLE = {
    "mirrored",
    "levels 3-6",
    "levels 1-4",
    "with 15 mm of ribs, CT",
    "with 15 mm of ribs, US",
    "another species: limbs 40 % longer",
}
CLEAN = set[str]()


def kind(name: str, *, clean: bool = False) -> Callable[[Maker], Maker]:
    def add(maker: Maker) -> Maker:
        KINDS[name] = maker
        if clean:
            CLEAN.add(name)
        return maker

    return add


def either(world: World, change: Callable[[Floats], Floats]) -> Case:
    """The change on one of the two clouds, or on both."""
    who = world.rng.integers(3)
    case = world.case()
    if who != 1:
        case.ct = change(case.ct)
    if who != 0:
        case.us = change(case.us)
    return case


@kind("clean", clean=True)
def _clean(w: World) -> Case:
    return w.case()


@kind("clean, front given", clean=True)
def _front(w: World) -> Case:
    return w.case(front=FRONT + w.rng.normal(scale=0.1, size=3))


@kind("noise 1.5 mm")
def _noise(w: World) -> Case:
    return w.case(us=w.us(noise=1.5))


@kind("US is the whole tube", clean=True)
def _tube(w: World) -> Case:
    return w.case(us=sample(w.target, 6000, w.rng, whole(), front=False))


@kind("roles swapped")
def _swapped(w: World) -> Case:
    case = w.case()
    return Case(case.us, case.ct, case.goal, case.waypoints)


@kind("300 points")
def _n300(w: World) -> Case:
    return w.case(w.ct(300), w.us(300))


@kind("600 points")
def _n600(w: World) -> Case:
    return w.case(w.ct(600), w.us(600))


@kind("1,000 points")
def _n1000(w: World) -> Case:
    return w.case(w.ct(1000), w.us(1000))


@kind("2,000 points", clean=True)
def _n2000(w: World) -> Case:
    return w.case(w.ct(2000), w.us(2000))


@kind("100,000 points", clean=True)
def _n100k(w: World) -> Case:
    return w.case(w.ct(100_000), w.us(60_000))


@kind("half given 8 times", clean=True)
def _eight(w: World) -> Case:
    def change(points: Floats) -> Floats:
        cut = np.median(points[:, w.rng.integers(3)])
        half = points[points[:, 0] > np.median(points[:, 0])] if w.rng.random() < 0.5 else points[points[:, 2] > cut]
        return np.concatenate([points, *[half] * 7])

    return either(w, change)


@kind("patch sampled 20 times", clean=True)
def _patch(w: World) -> Case:
    def change(points: Floats) -> Floats:
        middle = points[w.rng.integers(len(points))]
        patch = points[np.linalg.norm(points - middle, axis=1) < 12.5]
        return np.concatenate([points, *[patch + w.rng.normal(scale=0.3, size=patch.shape) for _ in range(20)]])

    return either(w, change)


@kind("one side 5 times denser", clean=True)
def _denser(w: World) -> Case:
    more = w.us(25_000)
    keep = (more[:, 0] > 0) | (w.rng.random(len(more)) < 0.2)
    return w.case(us=more[keep])


@kind("order shuffled, single precision", clean=True)
def _shuffled(w: World) -> Case:
    return either(w, lambda p: w.rng.permutation(p).astype(np.float32).astype(np.float64))


@kind("one cloud scaled")
def _scaled(w: World) -> Case:
    factor = w.rng.choice([0.5, 0.6, 0.7, 0.75, 1.35, 1.5, 1.75, 2.0, 3.0])
    case = w.case()
    if w.rng.random() < 0.5:
        case.ct, case.waypoints = case.ct * factor, case.waypoints * factor
    else:
        case.us, case.goal = case.us * factor, case.goal * factor
    return case


@kind("both twice or half life size")
def _both(w: World) -> Case:
    factor = w.rng.choice([0.5, 2.0])
    case = w.case()
    return Case(case.ct * factor, case.us * factor, case.waypoints * factor, case.goal * factor + 1e3)


@kind("stretched along one axis")
def _stretched(w: World) -> Case:
    factors = np.ones(3)
    factors[w.rng.choice([0, 2])] = w.rng.choice([0.6, 1.5])
    case = w.case()
    return replace(case, us=case.us * factors, goal=case.goal * factors)


@kind("mirrored")
def _mirrored(w: World) -> Case:
    case = w.case()
    return replace(case, us=case.us * [-1, 1, 1])


@kind("turned inside out, front given")
def _inside_out(w: World) -> Case:
    case = w.case(front=FRONT)
    return replace(case, us=case.us * [1, -1, 1])


@kind("front given wrong way")
def _wrong_front(w: World) -> Case:
    return w.case(front=-FRONT)


@kind("one branch missing")
def _branch(w: World) -> Case:
    return without_branches(w, 1)


@kind("two branches missing")
def _branches(w: World) -> Case:
    return without_branches(w, 2)


def without_branches(w: World, count: int) -> Case:
    who = w.rng.choice(["ct", "us"])
    points = w.ct() if who == "ct" else w.us()
    flat = w.canonical(points, who)
    _, index = tube_distance(flat)
    lines = centrelines()
    all_branches = list(product((-1, 1), (2, 3, 4, 5)))
    off = np.zeros(len(points), dtype=bool)
    for k in w.rng.choice(8, count, replace=False):
        side, level = all_branches[k]
        off |= (lines.level[index] == level) & (lines.side[index] == side) & (sternum_distance(flat) > 1.0)
    return w.case(**{who: points[~off]})


@kind("no sternum")
def _no_sternum(w: World) -> Case:
    return w.case(w.ct(keep=whole(sternum=(0.0, 0.0))))


@kind("US of one side")
def _one_side(w: World) -> Case:
    us = w.us()
    return w.case(us=us[us[:, 0] > -15] if w.rng.random() < 0.5 else us[us[:, 0] < 15])


@kind("US of the medial halves")
def _medial(w: World) -> Case:
    us = w.us(9000)
    return w.case(us=us[np.abs(us[:, 0] - np.median(us[:, 0])) < w.rng.uniform(35, 55)])


@kind("US without one level's outer half")
def _outer(w: World) -> Case:
    us = w.us()
    flat = w.canonical(us, "us")
    _, index = tube_distance(flat)
    lines = centrelines()
    level = w.rng.choice([2, 3, 4, 5])
    return w.case(us=us[~((lines.level[index] == level) & (np.abs(flat[:, 0]) > 35))])


@kind("strips of 15 mm missing")
def _wide_strips(w: World) -> Case:
    us = w.us(strips=0)
    for _ in range(3):
        middle = us[w.rng.integers(len(us))]
        angle = w.rng.uniform(0, np.pi)
        across = np.array([np.cos(angle), 0, np.sin(angle)])
        us = us[np.abs((us - middle) @ across) > 7.5] if w.rng.random() < 0.4 else us
    return w.case(us=us)


def extra(name: str, **crop: object) -> None:
    @kind(f"{name}, CT")
    def _ct(w: World) -> Case:
        return w.case(w.ct(9000, whole(**crop)))  # type: ignore[arg-type]

    @kind(f"{name}, US")
    def _us(w: World) -> Case:
        return w.case(us=w.us(7000, whole(**crop)))  # type: ignore[arg-type]

    @kind(f"{name}, both")
    def _both_clouds(w: World) -> Case:
        return w.case(w.ct(9000, whole(**crop)), w.us(7000, whole(**crop)))  # type: ignore[arg-type]


extra("with cartilage 1", levels=(1, 2, 3, 4, 5), sternum=(-78.0, 49.0))
extra("with cartilage 6", levels=(2, 3, 4, 5, 6), sternum=(-95.0, 8.0))
extra("with cartilages 1, 6, 7", levels=(1, 2, 3, 4, 5, 6, 7), sternum=(-128.0, 49.0))
extra("with 40 mm of ribs", bone_mm=40.0)
extra("with 15 mm of ribs", bone_mm=15.0)
extra("sternum uncut", sternum=(-128.0, 49.0))
extra("sternum cut 15 mm above the 2nd", sternum=(-78.0, 23.0))


@kind("levels 3-6")
def _shifted_levels(w: World) -> Case:
    keep = whole((3, 4, 5, 6), sternum=(-98.0, -20.0))
    return w.case(w.ct(keep=keep)) if w.rng.random() < 0.5 else w.case(us=w.us(keep=keep))


@kind("levels 1-4")
def _upper_levels(w: World) -> Case:
    keep = whole((1, 2, 3, 4), sternum=(-60.0, 42.0))
    return w.case(w.ct(keep=keep)) if w.rng.random() < 0.5 else w.case(us=w.us(keep=keep))


def scatter(points: Floats, share: float, rng: np.random.Generator) -> Floats:
    low, high = points.min(axis=0) - 10, points.max(axis=0) + 10
    return np.concatenate([points, rng.uniform(low, high, (int(share * len(points)), 3))])


@kind("5 % outliers")
def _few_outliers(w: World) -> Case:
    return w.case(us=scatter(w.us(), 0.05, w.rng))


@kind("30 % outliers")
def _many_outliers(w: World) -> Case:
    return w.case(us=scatter(w.us(), 0.3, w.rng))


@kind("a metal plate beside it")
def _plate(w: World) -> Case:
    plate = w.rng.uniform([-20, -2, -10], [20, 2, 10], (800, 3))
    us = w.us()
    return w.case(us=np.concatenate([us, plate + us[w.rng.integers(len(us))] + [0, w.rng.uniform(-20, 20), 0]]))


@kind("sweep lines shifted by 4-9 mm")
def _late(w: World) -> Case:
    us = w.us()
    line = np.floor((us[:, 2] - us[:, 2].min()) / 18).astype(int)
    return w.case(us=us + np.where(line % 2, 1, -1)[:, None] * [w.rng.uniform(4, 9), 0, 0])


@kind("breathing wave of 8 mm")
def _wave(w: World) -> Case:
    us = w.us()
    return w.case(us=us + 8 * np.sin(us[:, [0]] / 12) * [0, 0.7, 0.7])


@kind("one cartilage torn off and moved 15 mm")
def _torn(w: World) -> Case:
    us = w.us()
    flat = w.canonical(us, "us")
    _, index = tube_distance(flat)
    lines = centrelines()
    level, side = w.rng.choice([2, 3, 4, 5]), w.rng.choice([-1, 1])
    mine = (lines.level[index] == level) & (lines.side[index] == side) & (np.abs(flat[:, 0]) > 16)
    case = w.case(us=us + mine[:, None] * [0, 0, w.rng.choice([-15, 15])])
    return case


@kind("no chest: random blob")
def _blob(w: World) -> Case:
    case = w.case(us=w.rng.normal(size=(4000, 3)) * [80, 12, 50])
    return replace(case, goal=case.goal + 1e3)


@kind("no chest: plate with slots")
def _slots(w: World) -> Case:
    points = w.rng.uniform([-110, -3, -65], [110, 3, 65], (30000, 3))
    slots = (np.abs(points[:, 0]) > 15) & (np.abs((points[:, 2] + 65) % 32.5 - 16) < 7)
    case = w.case(us=points[~slots][:6000])
    return replace(case, goal=case.goal + 1e3)


@kind("no chest: four straight bars")
def _bars(w: World) -> Case:
    points = w.rng.uniform([-100, -4, -60], [100, 4, 60], (40000, 3))
    bars = (np.abs(points[:, 0]) < 14) | (np.abs((points[:, 2] + 60) % 30 - 15) < 6)
    case = w.case(w.ct(), points[bars][:6000])
    return replace(case, goal=case.goal + 1e3)


@kind("another species: limbs 40 % longer")
def _limbs(w: World) -> Case:
    case = w.case()
    away = np.abs(case.us[:, 0]) - 15
    return replace(case, us=case.us + np.where(away > 0, 0.4 * away * np.sign(case.us[:, 0]), 0)[:, None] * [1, 0, 0])


def run(name: str, seed: int, subject: str, number: int) -> dict[str, object]:
    """One case from its draws to its outcome."""
    rng = named_rng(seed, f"hostile/{name}/{subject}/{number}")
    row: dict[str, object] = {"kind": name, "seed": seed, "subject": subject, "number": number}
    case = KINDS[name](World(seed, subject, rng))
    T_ct, T_us = RigidTransform.random(rng), RigidTransform.random(rng)
    front = None if case.front is None else T_us.rotation @ case.front
    try:
        pair = register_pair(T_ct.apply(case.ct), T_us.apply(case.us), front=front)
        moved = pair.transfer(T_ct.apply(case.waypoints))
    except StudyError as error:
        return row | {"outcome": "refused", "message": str(error)}
    errors = point_errors_mm(moved, T_us.apply(case.goal))
    right = errors.mean() <= RIGHT_MEAN_MM and errors.max() <= RIGHT_WORST_MM
    outcome = "right" if right else "warned" if pair.warnings or not pair.converged else "wrong in silence"
    row |= {"outcome": outcome, "mean_mm": errors.mean(), "worst_mm": errors.max(), "message": "; ".join(pair.warnings)}
    return row | {f"q_{key}": value for key, value in vars(pair.quality).items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=15, help="of each class")
    parser.add_argument("--seeds", type=int, nargs=2, default=(401, 410), metavar=("FIRST", "LAST"))
    parser.add_argument("--only", help="classes whose name holds this")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--rows", type=Path, help="also write every case there")
    options = parser.parse_args()
    people = list(product(range(options.seeds[0], options.seeds[1] + 1), [f"ct{k}" for k in range(1, 6)]))
    work = []
    for name in KINDS:
        if options.only and options.only not in name:
            continue
        chosen = named_rng(0, name).permutation(len(people))
        work += [(name, *people[chosen[k % len(people)]], k) for k in range(options.cases)]
    import hostile  # by its name: what lives in __main__ and is cached can't travel to a worker

    rows = pd.DataFrame(Parallel(n_jobs=options.jobs)(delayed(hostile.run)(*one) for one in work))
    if options.rows:
        rows.to_csv(options.rows, index=False)
    print(report(rows))


def report(rows: pd.DataFrame) -> str:
    """The table by class and the rates of the whole."""
    rows = rows.assign(
        kind=[name + " *" if name in UNDECIDABLE else name for name in rows["kind"]],
        warned_right=(rows["outcome"] == "right") & (rows["message"] != ""),
        far=(rows["outcome"] == "wrong in silence") & (rows["mean_mm"] > FAR_MM),
    )
    table = rows.groupby("kind", sort=False)["outcome"].value_counts().unstack(fill_value=0)
    table = table.reindex(columns=["right", "refused", "warned", "wrong in silence"], fill_value=0)
    table["right, but warned"] = rows.groupby("kind", sort=False)["warned_right"].sum()
    table["silent, over 10 mm"] = rows.groupby("kind", sort=False)["far"].sum()
    table = table.reindex(dict.fromkeys(rows["kind"]))
    decidable = rows[~rows["kind"].str.endswith(" *")]
    clean = rows[rows["kind"].isin(CLEAN)]
    lost = clean["warned_right"] | (clean["outcome"] != "right")
    silent = (decidable["outcome"] == "wrong in silence").mean()
    return (
        f"{table.to_string()}\n\n{len(rows)} cases; of those that points can decide, wrong in silence: {silent:.1%}, "
        f"by more than {FAR_MM:g} mm: {decidable['far'].sum()}; of {len(clean)} clean cases "
        f"{lost.mean():.1%} refused, warned or wrong"
    )


if __name__ == "__main__":
    main()
