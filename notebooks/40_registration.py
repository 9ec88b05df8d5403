# %% [markdown]
# # What does each method make of the same pair?
#
# One CT, one patient, one coarse alignment, and every method of the study from there: sections III-C, III-D and IV of
# the paper. The skeleton graph moves each CT point by a blend of the local motions of its nearest nodes (Eqs. 3 and 4);
# the baselines are ICP, Amberg's non-rigid ICP and coherent point drift. A planned path is then carried to the patient
# by the sphere of section III-D (Fig. 4a), or by the field of a method that has one.
#
# **What is real and what is not.** In the phantom both people are synthetic. In `open`, of which two pairs are drawn in
# any case, the CTs are real people; in `planted` a real CT is deformed by a known map. The ultrasound cloud is
# simulated in every case, by a virtual tracked sweep over the patient's surface.

# %% tags=["parameters"]
dataset = "phantom"  # phantom, open or planted
profile = "full"  # full or quick
seed = 0

# %%
import numpy as np
import pandas as pd
from IPython.display import Markdown
from tqdm import tqdm

from study import METHODS, datasets, evaluation, figures, methods, params, pipeline, results

params.check_parameters(globals(), dataset=str, profile=str, seed=int)
data = datasets.find_dataset(dataset, params.find_profile(profile), seed)
pd.options.display.max_colwidth = None

# %% [markdown]
# ## The pair
# The typical one of the data set, not the easiest: the committed reference has each pair's mean waypoint error of the
# published graph, by the paper's protocol, and the pair at its median is taken. The CT cloud is the whole surface of
# sternum and cartilages 2 to 5. The ultrasound cloud is only what faces the probe, in the frame of a tracker whose base
# may be anywhere.

# %%
source, target = results.typical_and_worst(data.name, data.pairs())[0]
patient = data.patient(target)
pair = data.pair(data.anatomy(source), patient)
ct, us = pair.alignment.source.cloud.points, pair.alignment.target.cloud.points
T_us_chest = pair.alignment.target.T_cloud_chest
pd.DataFrame({"points": [len(ct), len(us)]}, index=[f"CT of {source}", f"US of {target}, simulated"])

# %% [markdown]
# ## Every method from the same start
# `coarse` is the start itself. A plain name is the method as published, or as its library ships it. `_visible`
# registers only the half of the tubes that a probe can see, `_tuned` does so with parameters from a grid on development
# subjects that are reported nowhere else, `_tuned_whole` was tuned on the whole tube; `skeleton_graph_authors` has
# every choice of the authors' code. The skeleton graph has converged if the errors of its two maps no longer fell when
# their schedules ended. Seconds are of this machine and this run.

# %%
answers = {
    name: pipeline.register_aligned(pair.alignment, method, data.rng(f"{pair.name}/{name}"))
    for name, method in tqdm(METHODS.items(), "methods")
}
judged = {name: evaluation.Judgement(pair, result, data.params.radius_mm) for name, result in answers.items()}
pd.DataFrame(
    {
        name: {
            "converged": result.converged,
            "iterations": result.n_iterations,
            "why it stopped": result.stop_reason,
            "seconds": round(result.seconds, 1),
            "warnings": "; ".join(result.warnings) or "none",
        }
        for name, result in answers.items()
    }
).T

# %% [markdown]
# ## Overlays
# Grey is the ultrasound cloud; each CT point is coloured by its distance to it. Seen from the front, a rigid method
# leaves the ends of the cartilages apart where two people differ. Seen from the right, the whole tube of the CT lies
# over a sheet: a method that only asks for small distances pulls the tube flat onto the sheet, back side and all.

# %%
# The others look like one that is drawn.
drawn = ["coarse", "icp", "nonrigid_icp", "cpd", "skeleton_graph", "cpd_tuned", "skeleton_graph_repaired"]
drawn.append(methods.BEST_METHOD)
figures.registration_grid({name: answers[name].warped for name in drawn}, us, T_us_chest=T_us_chest)

# %% [markdown]
# Distances between the clouds, in mm: the Hausdorff distance of Eq. 5 over all points, its 95th percentile and the mean
# of both directions; then the two directed Hausdorff distances, from CT to US and from US to CT. Where the first of
# them is the larger, the worst point is a CT point with no US near it: an unseen back or an overhanging end.

# %%
surface = pd.DataFrame(
    {
        name: {
            "HD (Eq. 5)": judgement.surface.hausdorff_mm,
            "HD, 95 %": judgement.surface.hd95_mm,
            "mean": judgement.surface.mean_mm,
            "CT to US, largest": judgement.surface.forth.max(),
            "US to CT, largest": judgement.surface.back.max(),
        }
        for name, judgement in judged.items()
    }
).T
surface.round(2)

# %% [markdown]
# ## The path, carried over
# The 20 waypoints lie in the intercostal spaces, where there is no cartilage to register; each is moved by the rigid
# motion of the CT points within the sphere around it, or by the method's field where it has one. Hollow circles are the
# waypoints that the protocol defines on the patient's own cloud (k-means parts of each cartilage, midpoints between
# neighbours); an arrow runs from there to where the waypoint was carried, drawn longer than it is.

# %%
moved = {name: judgement.moved for name, judgement in judged.items()}
protocol = evaluation.intercostal_waypoints(patient.labelled)
figures.transferred_path(us, protocol, {name: moved[name] for name in drawn}, T_us_chest=T_us_chest)

# %% [markdown]
# ## Real people: a typical and a worst pair
# The paper's Fig. 4a on CTs of real people, `open`, each registered to another one in a simulated sweep. Of all pairs
# in the committed reference, the typical one has the median and the worst the largest mean waypoint error of the
# published graph by the paper's protocol. What is true between two people is not known.

# %%
people = datasets.find_dataset("open", params.find_profile(profile), seed)
views = {}
for what, names in zip(("typical", "worst"), results.typical_and_worst("open", people.pairs()), strict=True):
    case = people.pair(people.anatomy(names[0]), someone := people.patient(names[1]))
    found = {
        name: pipeline.register_aligned(case.alignment, METHODS[name], people.rng(f"{case.name}/{name}"))
        for name in ("icp", "cpd", "skeleton_graph", methods.BEST_METHOD)
    }
    views[f"{what}: {names[0]} to {names[1]}"] = figures.PairView(
        target=case.alignment.target.cloud.points,
        goal=evaluation.intercostal_waypoints(someone.labelled),
        warped={name: answer.warped for name, answer in found.items()},
        moved={
            name: evaluation.Judgement(case, answer, people.params.radius_mm).moved for name, answer in found.items()
        },
        T_us_chest=case.alignment.target.T_cloud_chest,
    )
figures.pairs_grid(views, "Real people, simulated ultrasound: waypoint errors by the paper's protocol")

# %% [markdown]
# ## Against the protocol, and against the truth
# The paper can only compare with the waypoints that its protocol defines on the patient. Here the deformation is
# known on `phantom` and `planted`, so the same transferred waypoints are also judged by where they truly belong. The
# column in the feature plane leaves depth out; the last one is the mean depth error alone, positive to the front.

# %%
normal = T_us_chest.rotation[:, 2]
goals = {"protocol": protocol.points} | ({"truth": pair.true_waypoints} if pair.has_truth else {})


def described(points, goal):
    """How far carried waypoints lie from where they should, in numbers."""
    whole, inside = (evaluation.waypoint_errors_mm(points, goal, plane) for plane in (None, normal))
    return {
        "mean (mm)": whole.mean(),
        "SD (mm)": evaluation.population_sd(whole),
        "largest (mm)": whole.max(),
        "in the plane (mm)": inside.mean(),
        "depth (mm)": ((points - goal) @ normal).mean(),
    }


by_goal = {goal: pd.DataFrame({n: described(p, goals[goal]) for n, p in moved.items()}).T for goal in goals}
errors = pd.concat(by_goal, axis="columns")
errors.assign(n=len(protocol)).round(2)

# %% [markdown]
# What to look for where the truth is known: a method that lays the middle of the tube on its visible front is too far
# to the front, and the protocol does not see it, as its waypoints on the ultrasound cloud share that shift. A method
# that fits front to front keeps the depth right, and may look worse to the protocol for it.

# %%
is_rigid = {  # to rounding
    name: np.allclose(result.warped, result.T_us_ct.apply(ct), rtol=0, atol=1e-6) for name, result in answers.items()
}
rigid, bends = ([name for name in moved if is_rigid[name] == wanted] for wanted in (True, False))
planes = [errors[goal, "in the plane (mm)"] for goal in goals]
better = [name for name in bends if all(plane[name] < plane[rigid].min() for plane in planes)]
named = {True: ", ".join(f"`{n}`" for n in better), False: ", ".join(f"`{n}`" for n in bends if n not in better)}

# %%
text = f"`{data.name}`: two real people, the true correspondence is not known, so nothing to see here."
if pair.has_truth:
    ours, seen = errors["protocol"], errors["truth"]
    best, truest = ours["mean (mm)"].idxmin(), seen["mean (mm)"].idxmin()
    levelled = seen["depth (mm)"].abs().idxmin()
    text = (
        f"- In the feature plane, of the methods that bend, these beat every rigid one by either judge: "
        f"{named[True] or 'none'}. These do not: {named[False] or 'none'}.\n"
        f"- Best by the protocol: `{best}`, {ours.loc[best, 'mean (mm)']:.1f} mm. By the truth it "
        f"errs by {seen.loc[best, 'mean (mm)']:.1f} mm, with a mean depth error of "
        f"{seen.loc[best, 'depth (mm)']:+.1f} mm.\n"
        f"- Best by the truth: `{truest}`, {seen.loc[truest, 'mean (mm)']:.1f} mm, where the protocol sees "
        f"{ours.loc[truest, 'mean (mm)']:.1f} mm. Least wrong in depth: `{levelled}`, "
        f"{seen.loc[levelled, 'depth (mm)']:+.1f} mm."
    )
Markdown(text)

# %% [markdown]
# ## What this shows
# Every method answers in the same form, row i for CT point i, so one transfer serves all; a rigid method's path is its
# own motion exactly. In the feature plane the skeleton graph as published carries the path better than the coarse
# alignment it starts from.

# %%
assert list(answers) == list(METHODS), "every method must have answered"
for name, result in answers.items():
    assert result.warped.shape == ct.shape, f"{name}: expected one row per CT point"
    if is_rigid[name]:
        carried = result.T_us_ct.apply(pair.waypoints_ct)
        # A rigid fit to exactly paired points has no error but rounding: coordinates of some 1,000 mm in float64.
        assert np.abs(moved[name] - carried).max() < 1e-6, f"{name}: a rigid path must be its own motion"
graph, start = ("skeleton_graph", "coarse")
in_plane = errors[list(goals)[-1], "in the plane (mm)"]  # by the truth, if it is known
# The issue of this study asks 2.5 mm in the feature plane; the quick profile has a third of the points, and two real
# people differ in more than the phantom's deformations do, so there it must only improve on its start.
assert in_plane[graph] < in_plane[start], f"expected an improvement on the coarse alignment, got {in_plane.to_dict()}"
if data.people == "synthetic" and profile == "full":
    assert in_plane[graph] <= 2.5, f"expected at most 2.5 mm in the feature plane, got {in_plane[graph]:.2f}"
# ICP minimises distances, so its clouds cannot be farther apart than where it started; 0.05 mm is that metric's
# tolerance between machines.
assert surface.loc["icp", "mean"] <= surface.loc[start, "mean"] + 0.05, "ICP must bring the clouds closer"
