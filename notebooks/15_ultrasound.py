# %% [markdown]
# # How does a tracked sweep become a cloud, and what do its errors cost?
#
# §II-A to II-C.2 of the paper: a linear probe is moved over the chest in several lines, its pose comes from a robot,
# the upper surface of bone and cartilage is annotated in each frame, and all frames are stacked in space. That needs
# the latency between images and poses (§II-B) and the place of the image on the probe. At the end each source of
# error is switched on alone: what does it do to the cloud, and what to the waypoints?
#
# **Everything here is simulated.** No tracked sweep over cartilage is public, so a virtual probe scans a surface that
# we know: that of a synthetic person (`phantom`), of a real CT (`open`) or of a real CT under a known deformation
# (`planted`). The code that makes the cloud does not know that; a real sweep takes the same road (see `docs/use.md`).

# %% tags=["parameters"]
dataset = "phantom"  # phantom, open or planted
profile = "full"  # full or quick
seed = 0

# %%
import numpy as np
import pandas as pd

from study import datasets, evaluation, figures, params, seeds, ultrasound
from study.types import RigidTransform

params.check_parameters(globals(), dataset=str, profile=str, seed=int)
data = datasets.find_dataset(dataset, params.find_profile(profile), seed)
probe = ultrasound.Probe()
SPACING_MM = params.find_profile("full").us_spacing_mm  # of the clouds in every profile: a sparser one may be refused
pd.options.display.max_colwidth = None

# %% [markdown]
# ## Temporal calibration (§II-B)
# The tool moves up and down over a landmark. Robot and image disagree on when: the upper panel shows the height as the
# robot stamped it against the depth as the images were stamped, the lower one the same after the images were moved
# back. The motion is simulated, with one pixel of noise on the landmark and frames that are not quite evenly spaced.

# %%
run = ultrasound.simulate_latency_run(ultrasound.LATENCY_S, seeds.named_rng(seed, "us/latency"), probe=probe)
latency = ultrasound.calibrate_latency(*run)
figures.latency_fit(*run, latency.latency_s)

# %% [markdown]
# The same for other latencies, planted and recovered; one of them is the paper's.

# %%
recovered = []
for planted_s in (0.0, 0.1, 0.2, ultrasound.LATENCY_S, 0.3, 0.4, 0.5):
    rng = seeds.named_rng(seed, f"us/latency/{planted_s}")
    found = ultrasound.calibrate_latency(*ultrasound.simulate_latency_run(planted_s, rng, probe=probe))
    recovered.append(
        {
            "planted (ms)": 1000 * planted_s,
            "recovered (ms)": 1000 * found.latency_s,
            "off (ms)": 1000 * (found.latency_s - planted_s),
            "standard error (ms)": 1000 * found.sd_s,
            "correlation": found.correlation,
        }
    )
recovered = pd.DataFrame(recovered).round(
    {"recovered (ms)": 1, "off (ms)": 2, "standard error (ms)": 2, "correlation": 4}
)
recovered.set_index("planted (ms)")

# %% [markdown]
# ## Spatial calibration
# Where is the image on the probe? A point in a water bath is seen all over the image, from many sides; one transform
# must send all these pixels to one place. The views are simulated with half a pixel of noise. The residual is what a
# real calibration could report; how far the answer is off can only be known here.

# %%
views = ultrasound.simulate_calibration_views(seeds.named_rng(seed, "us/spatial"), probe=probe)
spatial = ultrasound.calibrate_spatial(*views)
off = spatial.T_probe_image @ probe.T_probe_image.inverse
shift_mm = float(np.linalg.norm(spatial.T_probe_image.translation - probe.T_probe_image.translation))
pd.DataFrame(
    {
        "residual, root mean square (mm)": [spatial.residual_mm],
        "standard error (mm)": [spatial.sd_mm],
        "standard error (°)": [spatial.sd_deg],
        "truly off (mm)": [shift_mm],
        "truly off (°)": [off.angle_deg],
        "pixel found (mm)": [" × ".join(f"{s:.4f}" for s in spatial.pixel_spacing_mm)],
    },
    index=["point in a water bath, simulated"],
).round(3).T

# %% [markdown]
# ## One frame
# What the probe meets first under each of its columns, as an annotator would draw it: a thin line along the upper
# surface. The picture behind it looks like B-mode and is simulated from the CT in the plane of the frame, to show what
# an annotator would look at: cartilage dark between its upper surface and the pleura, bone with a shadow. Only the
# line goes on. This frame is of a sweep without errors. A planted deformation has no CT of its own, so no picture.

# %%
source, target = data.pairs()[0]
anatomy, patient = data.anatomy(source), data.patient(target)
surface = patient.anatomy.mesh


def sweep_with(errors, repeat=None):
    """The patient's sweep under some errors; every case of one repeat shares its random draws."""
    rng = seeds.named_rng(seed, f"{target}/sweep" if repeat is None else f"{target}/sweep/{repeat}")
    return ultrasound.simulate_sweep(surface, datasets.FRONT, errors, rng, T_base_patient=patient.T_us_ras, name=target)


sweep = sweep_with(ultrasound.SweepErrors())
clean = sweep_with(ultrasound.SweepErrors.none())  # else picture and line would not lie over each other
poses, _, tracked = clean.frame_poses()
fullest = int((clean.masks.any(axis=1).sum(axis=1) * tracked).argmax())
picture = None
if patient.anatomy.image is not None:
    T_us_image = RigidTransform.from_matrix(poses[fullest]) @ clean.T_probe_image
    plane = patient.T_us_ras.inverse @ T_us_image
    shape, speckle = clean.masks.shape[1:], seeds.named_rng(seed, "us/speckle")
    picture = ultrasound.frame_of(
        patient.anatomy.image, patient.anatomy.mask, plane, shape, clean.pixel_spacing_mm[0], speckle
    )
title = f"frame {fullest} of {clean.n_frames}{', B-mode-like' * (picture is not None)}, simulated"
figures.frame_with_mask(clean.masks[fullest], clean.pixel_spacing_mm, picture, title)

# %% [markdown]
# ## The sweep in space
# Lines up and down the body over the skin, the transducer drawn in some frames, and the cloud they give over the
# surface that was scanned, in the frame of the tracker (turned here to look from the front). The cloud lies on the
# front of the cartilages only, and has gaps between lines.

# %%
poses, _, tracked = sweep.frame_poses()
edges = sweep.T_probe_image.apply([[0, 0, 0], [sweep.pixel_spacing_mm[0] * (sweep.masks.shape[2] - 1), 0, 0]])
transducer = np.einsum("fij,kj->fki", poses[:, :3, :3], edges) + poses[:, None, :3, 3]
figures.sweep_in_space(
    transducer.mean(axis=1),
    patient.cloud,
    surface.moved(patient.T_us_ras),
    times_s=sweep.frame_times_s,
    footprints=transducer[tracked][::25],
    T_cloud_chest=patient.T_us_ras @ figures.T_RAS_CHEST,
)

# %%
report = patient.report
pd.Series(
    {
        "frames": report.n_frames,
        "dropped, outside the tracked time": report.n_outside,
        "dropped, no valid pose": report.n_untracked,
        "used, but nothing in the mask": report.n_empty,
        "contour points": report.n_contour,
        "points of the cloud": report.n_points,
        "image size (px)": " × ".join(map(str, probe.shape[::-1])),
        "length of the sweep (s)": f"{np.ptp(sweep.frame_times_s):.1f}",
    },
    name="sweep",
).to_frame()

# %% [markdown]
# ## The cloud over the true surface
# Left: no errors at all, so what is left is the pixel. Middle: every source of error, with the latency calibrated away
# up to its residual. Right: the same, but the latency left in. Lines run in opposite directions, so an uncorrected
# latency moves them apart, along the body; the colour shows it least where the surface itself runs that way.

# %%
visible = ultrasound.visible_mesh(surface, datasets.FRONT)
scanned = evaluation.Scanned(surface, visible, patient.T_us_ras, patient.anatomy.waypoints.points)
cases = dict(ultrasound.budget_cases())
shown = {"no errors": "none", "all": "all", "all, latency left in": "all, latency not corrected"}
clouds = {}
for title, name in shown.items():
    seen = ultrasound.sweep_cloud(sweep_with(cases[name]), spacing_mm=SPACING_MM)
    clouds[title] = scanned.in_ras(seen.cloud.points)
figures.cloud_errors({title: (points, scanned.distances_mm(points)) for title, points in clouds.items()}, visible)

# %% [markdown]
# ## The errors, and where their sizes come from

# %%
pd.DataFrame(ultrasound.error_table()).set_index(["source", "field"])

# %% [markdown]
# ## What each error costs
# Each row of the figure is one source alone; the last two are all together. Left: how far the cloud lies from the
# surface that a probe can see. Right: how far the 20 waypoints, carried from one CT, end from where they are defined on
# the patient, after a whole registration, coarse alignment included, in the feature plane; a panel a method, as
# published or shipped and tuned on the visible surface. A line spans the sweeps of the same patient, and every row of
# one sweep shares its random draws.
# Where the coarse alignment refuses a cloud (the reasons follow below), the methods are started by hand: from the
# alignment of the sweep without errors, with the true parts as labels, so that the row still says what the error costs.

# %%
REPEATS = {"full": 2, "quick": 1}
SHIPPED = ["icp", "nonrigid_icp", "cpd", "skeleton_graph"]
budget = evaluation.error_budget(
    data.pair(anatomy, patient),
    scanned,
    sweep_with,
    seed=seed,
    repeats=REPEATS[profile],
    spacing_mm=SPACING_MM,
    radius_mm=data.params.radius_mm,
    methods=[*SHIPPED, *(f"{name}_tuned" for name in SHIPPED)],
)
in_plane = budget.rows[budget.rows["metric"] != "waypoint_error"].replace(
    {"metric": {"waypoint_error_inplane": "waypoint_error"}}
)
figures.error_budget(in_plane, note=f"by the paper's protocol, in the feature plane; {figures.SIMULATED}")

# %% [markdown]
# What the errors do to the cloud. The distance of a cloud to a surface hides a shift along that surface, so `points
# moved` says how far the contour points themselves went; it is blank where a source changes which pixels see the
# surface, so that points do not pair. `covered` is the part of the visible surface that has a point of the cloud beside
# it; `by hand` counts the sweeps whose coarse alignment was refused.

# %%
columns = {"cloud to surface (mm)": "surface_distance", "points moved (mm)": "moved", "covered (%)": "covered"}
table = pd.DataFrame({title: budget.mean(metric)[""] for title, metric in columns.items()})
table.insert(0, "by hand", budget.by_hand())
print(f"{REPEATS[profile]} sweeps of each case")
table.style.format("{:.2f}", na_rep="", subset=list(columns)).format("{:.0f}", na_rep="", subset=["covered (%)"])

# %% [markdown]
# What they do to the waypoints, in the feature plane and in space, mean error in mm by method. Errors in space hide a
# trap: a CT cloud holds whole tubes, ultrasound only their front, which costs half a cartilage's thickness from front
# to back. An error that makes echoes seem deeper, such as the speed of sound, moves the sheet towards the middle of the
# tubes and can make the error in space smaller. That is a bias cancelling a bias, not an improvement; in the plane
# there is no such thing.

# %%
labels = {method: figures.method_style(method).label for method in budget.methods}
costs = {
    kind: budget.mean(metric).rename(columns=labels)
    for kind, metric in (("in the plane", "waypoint_error_inplane"), ("in space", "waypoint_error"))
}
costs["in the plane"].rename_axis("in the feature plane (mm)").style.format("{:.2f}")

# %%
costs["in space"].rename_axis("in space (mm)").style.format("{:.2f}")

# %%
print(f"the coarse alignment refused {len(budget.refused)} of {REPEATS[profile] * len(cases)} sweeps")
budget.refused.groupby("error", sort=False).agg(sweeps=("sweep", "size"), reason=("reason", "first"))

# %% [markdown]
# ## What this shows
# Both calibrations come back within the bounds that the error sizes above assume, a sweep without errors is the
# visible surface, one with all of them stays near it, and a latency left in moves every point by speed times lag:
# calibrating it away is what matters most. Left in, it shifts the lines against each other until even a straight
# cartilage looks bent; the coarse alignment may then refuse the cloud rather than guess where the head is.

# %%
assert recovered["off (ms)"].abs().max() < 5.0, "5 ms is a tenth of a millimetre at the speed of the hand"
assert shift_mm < 0.3, f"expected the image within 0.3 mm of its place, got {shift_mm:.2f} mm"
assert off.angle_deg < 0.3, f"expected the image within 0.3° of its place, got {off.angle_deg:.2f}°"
distance = table["cloud to surface (mm)"]
assert distance["none"] < 0.2, f"a sweep without errors must lie within a pixel of the surface, got {distance['none']}"
assert distance["all"] < 1.5, f"all errors together must stay below half a cartilage, got {distance['all']} mm"
assert distance["latency"] == distance[budget.errors[1:-2]].max(), "a latency left in must be the worst single error"
lag_mm = probe.speed_mm_s * ultrasound.LATENCY_S
moved_mm = table["points moved (mm)"]["latency"]
# The hand strays a little and stops at each turn, so its mean speed is not quite the nominal one.
assert abs(moved_mm - lag_mm) < 0.1 * lag_mm, (
    f"expected a shift of speed times lag, {lag_mm:.2f} mm, got {moved_mm:.2f}"
)
usual = budget.refused[~budget.refused["error"].isin(["latency", "all, latency not corrected"])]
assert usual.empty, f"the coarse alignment must take a sweep with ordinary errors:\n{usual}"
graph = costs["in the plane"][labels["skeleton_graph"]]
assert graph["all, latency not corrected"] > graph["all"], "a latency left in must cost the waypoints something"
