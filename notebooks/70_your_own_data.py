# %% [markdown]
# # Two clouds of your own: where do your waypoints end, and should you believe it?
#
# From two files to a checked result: load a CT cloud and an ultrasound cloud, register them, look at what the result
# says of itself, carry waypoints, save. The files are a small pair in `samples/`; put the names of your own there.
#
# **What is real and what is not.** Nothing of the sample is: two synthetic people of the study's phantom, one with a
# CT, the other under a simulated sweep. The deformation between them is known. That is why the last part can say how
# far off the waypoints truly are; for your own patient nobody can.

# %% tags=["parameters"]
dataset = "phantom"  # has no effect: the files below are read
profile = "full"  # full or quick: quick thins the clouds
seed = 0

# %%
import numpy as np
import pandas as pd

import study
from study import evaluation, figures, files, params
from study.alignment import find_chest
from study.files.places import CHECKOUT
from study.types import PointCloud

params.check_parameters(globals(), dataset=str, profile=str, seed=int)
folder = CHECKOUT / "samples"
CT, US, WAYPOINTS = folder / "ct.ply", folder / "us.ply", folder / "waypoints.csv"
FRONT = None  # (x, y, z) from the chest to the probe, in the frame of US; None where it is not known
OUT = CHECKOUT / "results" / "trials" / "your_own_data"

# %% [markdown]
# ## Load
# Clouds are PLY files in mm, in any rigid pose. Both hold the sternum and the cartilages of ribs 2-5 of both sides, cut
# at the bone, and nothing else. A property `time` of the ultrasound's vertices says when each point was seen; it lets a
# method take breathing off. Waypoints are a CSV file with columns `x`, `y`, `z` and, if you like, `label`.

# %%
ct = files.read_ply(CT)
us, times = files.read_timed_ply(US)
waypoints = files.read_waypoints(WAYPOINTS)
if profile == "quick":
    ct, us, times = ct[::2], us[::2], None if times is None else times[::2]
pd.DataFrame(
    {
        "points": [len(ct), len(us), len(waypoints)],
        "what": ["CT cloud", "ultrasound cloud, simulated", "waypoints in the CT's frame"],
    },
    index=[CT.name, US.name, WAYPOINTS.name],
)

# %% [markdown]
# ## Register
# `study.BEST_METHOD` has the smallest true error in this study. What cannot be a chest is refused here, with a reason.
# The direction to the probe, which a tracker knows, tells front from back; without it the shape alone has to decide.

# %%
pair = study.register_pair(ct, us, method=study.BEST_METHOD, seed=seed, front=FRONT, times=times)
pair

# %% [markdown]
# ## Should you believe it?
# First the warnings: a result with a warning, or one that has not converged, should not guide a probe. Then what the
# result measures of itself. None of it replaces a look: points alone do not tell levels 2-5 from 3-6.

# %%
for warning in pair.warnings:
    print(f"warning: {warning}")
print(f"{len(pair.warnings)} warnings; converged: {pair.converged} ({pair.stop_reason})")
pd.Series(vars(pair.quality)).to_frame("quality")

# %%
T_us_chest = find_chest(PointCloud(us, "us", front=FRONT)).T_cloud_chest  # so that the picture looks from the front
title = "The CT cloud where it was registered to, on the ultrasound cloud (grey)"
figures.registration_grid({study.BEST_METHOD: pair.warped}, us, T_us_chest=T_us_chest, title=title)

# %% [markdown]
# ## Carry the waypoints
# Each with its bound: how far it may be off, 19 times in 20, for people like those it was calibrated on
# (`docs/limits.md` says where it fails).

# %%
carried = pair.transfer(waypoints.points)
bounds_mm = pair.bounds(waypoints.points)
table = pd.DataFrame(carried, columns=["x (mm)", "y (mm)", "z (mm)"], index=pd.Index(waypoints.labels, name="waypoint"))
table.assign(**{"bound (mm)": bounds_mm}).round(1)

# %% [markdown]
# ## Save
# The same files as `study register` writes: the warped cloud, the waypoints, and what the result says of itself.

# %%
for line in files.write_registration(pair, OUT, waypoints):
    print(line.replace(f"{CHECKOUT}/", ""))

# %% [markdown]
# ## How far off is it, truly?
# Only for the sample, whose deformation is known. With your own files there is no such table; leave it out.

# %%
truth = files.read_waypoints(folder / "waypoints_true.csv")
errors_mm = evaluation.waypoint_errors_mm(carried, truth.points)
pd.Series(
    {
        "mean (mm)": errors_mm.mean(),
        "largest (mm)": errors_mm.max(),
        "within the bound (%)": 100 * (errors_mm <= bounds_mm).mean(),
    },
    name="true waypoint error",
).round(2).to_frame()

# %% [markdown]
# ## What this shows
# Two files are enough for a result that says how far it can be trusted; on the sample it is right to a few millimetres.

# %%
assert pair.warped.shape == ct.shape, "one row for each point that was given"
assert pair.converged, f"the sample must register: {pair.stop_reason}"
assert truth.labels == waypoints.labels, "the truth must be of the same waypoints"
# Half the width of a cartilage, about 14 mm, still leaves a probe between the same two ribs; the sample must do better.
assert errors_mm.mean() < 4.0, f"expected a mean true error below 4 mm, got {errors_mm.mean():.2f} mm"
again = files.read_waypoints(OUT / "waypoints_us.csv")
assert np.allclose(again.points, carried), "what was saved must be what was shown"
