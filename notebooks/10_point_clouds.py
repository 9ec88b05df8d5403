# %% [markdown]
# # What becomes of a CT on its way to a point cloud?
#
# §II-C.1 of the paper: the sternum and the cartilages of ribs 2-5 are cut out of a chest CT, the surface of what is
# left is sampled evenly, and that cloud is all the registration ever sees of the CT. The paper cuts by hand in a mesh
# editor. Here the cut is code, so that it can be repeated: from label volumes where they exist, from rib labels, or
# from a small file of landmarks that was picked once and is kept under version control.
#
# **What is real and what is not.** `open` holds CTs of real people. The CTs of `phantom` are generated, and their
# labels are exact; they take the same road through the code.

# %% tags=["parameters"]
dataset = "open"  # open, phantom or planted
profile = "full"  # full or quick
seed = 0

# %%
from dataclasses import replace

import numpy as np
import pandas as pd

from study import cohorts, figures
from study.anatomy import measure_anatomy
from study.cartilage_growth import parts_from_ribs
from study.ct import on_grid, points_for_spacing, surface
from study.data.fetch import fetch
from study.data.landmarks import read_landmarks
from study.data.manifest import load_manifest
from study.data.volumes import read_labels
from study.errors import StudyError
from study.geometry import sample_spacing_mm
from study.params import check_parameters, find_profile
from study.sweep import surface_distance_mm
from study.types import Part

check_parameters(globals(), dataset=str, profile=str, seed=int)
params = find_profile(profile)
pd.options.display.max_colwidth = None
manifest = load_manifest()

# %% [markdown]
# ## Who was cut how
# Labels of sternum and cartilages are used as they are: split by rib and side, the 5th cut from the arch of 6-10, the
# sternum cut to the span of the cartilages. Landmarks are the paper's manual step written down: rib ends, attachments
# and the sternum's midline; the cartilage grows between them by density and shape.

# %%
entries = dict(manifest.cohort("open" if dataset == "planted" else dataset).subjects)
if dataset == "planted":
    entries = {cohorts.PLANTED_SOURCE[1]: entries[cohorts.PLANTED_SOURCE[1]]}  # the others are this one, deformed
if profile == "quick":
    entries = dict(list(entries.items())[:2])
how, by, unsure = {}, {}, {}
for name, entry in entries.items():
    path = manifest.landmarks_path(entry)
    if entry.labels or entry.ct is None:
        how[name] = "labels" if entry.ct else "labels, exact"
        by[name] = manifest.file(entry.labels.file).oddities[0] if entry.labels else "made with the image"
    elif entry.rib_labels:
        how[name], by[name] = "rib labels", manifest.file(entry.rib_labels.file).title
    elif path is not None and path.is_file():
        landmarks = read_landmarks(path)
        how[name], by[name], unsure[name] = "landmarks", landmarks.made_by, "; ".join(landmarks.hard_to_see)
    else:
        how[name], by[name] = "not yet", f"waits for {entry.landmarks}"
pd.DataFrame({"cut by": how, "made by": by, "hard to see": unsure}).fillna("").reindex(list(entries))

# %%
people = {}
for name in entries:
    try:
        people[name] = cohorts.load_anatomy(dataset, name, params, seed)
    except StudyError as error:
        print(f"{name} is left out: {error}")
print(f"{len(people)} of {len(entries)} subjects: {', '.join(people)}")

# %% [markdown]
# ## Slice, surface, cloud
# For one subject of each kind. In the slices every outline should follow the edge of a cartilage, which is only a
# little brighter than the muscle around it, and end where the rib begins. The surface should have no bridges between
# ribs. The cloud is the surface sampled evenly (Poisson discs), so that the density of points tells the registration
# nothing.

# %%
one_of_each = {how[name]: name for name in reversed(people)}  # the first of each kind
names = dict.fromkeys([*reversed(one_of_each.values()), *people])
examples = [people[name] for name in list(names)[:2]]


def slices(one):
    """A subject's parts on its CT, under the subject's name."""
    return figures.ct_slice(replace(one.image, name=one.name), on_grid(one.mask, one.image))


print(" and ".join(f"{one.name}, cut by {how[one.name]}" for one in examples))
slices(examples[0])

# %%
figures.mesh_and_cloud(examples[0].mesh, examples[0].cloud)

# %% [markdown]
# The same for another subject: one cut in the other way, where there is one. Cut by landmarks, a cartilage is grown on
# a grid of its own, here laid over the voxels of the CT.

# %%
slices(examples[-1])

# %%
figures.mesh_and_cloud(examples[-1].mesh, examples[-1].cloud)

# %% [markdown]
# ## Points and their spacing
# `spacing` is the median distance to the nearest neighbour; `to the surface` is how far the worst point lies from the
# surface it was drawn from. The last column says how many points the density of the ultrasound cloud would take.

# %%
clouds = pd.DataFrame(
    {
        name: {
            "points": len(one.cloud),
            "triangles": len(one.mesh.faces),
            "spacing (mm)": sample_spacing_mm(one.cloud.points),
            "to the surface, at most (mm)": surface_distance_mm(one.cloud.points, one.mesh).max(),
            "fewest points on a part": min(len(one.cloud.only(part)) for part in Part if part != Part.UNKNOWN),
            "width (mm)": np.ptp(one.mesh.vertices[:, 0]),
            "height (mm)": np.ptp(one.mesh.vertices[:, 2]),
            f"points for {params.us_spacing_mm:g} mm": points_for_spacing(one.mesh, params.us_spacing_mm),
        }
        for name, one in people.items()
    }
).T
counts = [name for name in clouds if not name.startswith(("spacing", "to the", "width", "height"))]
clouds.round(2).astype(dict.fromkeys(counts, int))

# %% [markdown]
# ## Is grown cartilage the same as labelled cartilage?
# One real CT has labels of cartilage and of ribs. Here its cartilages are grown from the CT and the *rib* labels alone
# and laid over those of its cartilage labels, which the growth never saw: Dice, and the distance between the surfaces.
# The picture goes through the worst place, ringed: colour is grown, white dashes are the labels. Both come from
# algorithms, so agreement is not proof; where they disagree the density in the slice tells who is right.

# %%
judged = next((n for n, e in entries.items() if e.labels and e.ct and profile == "full" and dataset == "open"), None)
agreement = None
if judged is None:
    print("only with dataset=open and profile=full")
else:
    labelled, labels = people[judged], entries[judged].labels
    ids = manifest.label_ids(labels.map)
    grown = parts_from_ribs(labelled.image, read_labels(fetch(manifest.file(labels.file)), labelled.image), ids)
    grown_mesh = surface(grown)

    ours, theirs = (on_grid(mask, labelled.image) for mask in (grown, labelled.mask))
    one, other = (volume.values != Part.UNKNOWN for volume in (ours, theirs))
    places = np.concatenate([grown_mesh.vertices, labelled.mesh.vertices])
    far = np.concatenate(
        [
            surface_distance_mm(grown_mesh.vertices, labelled.mesh),
            surface_distance_mm(labelled.mesh.vertices, grown_mesh),
        ]
    )
    agreement = pd.Series(
        {
            "Dice, all parts": 2 * (one & other).sum() / (one.sum() + other.sum()),
            "surfaces apart, mean (mm)": far.mean(),
            "95 % below (mm)": np.percentile(far, 95),
            "worst (mm)": far.max(),
        },
        name=judged,
    )
agreement.round(2).to_frame() if agreement is not None else None

# %%
figures.ct_slice(
    replace(labelled.image, name=judged), ours, reference=theirs, at_mm=places[far.argmax()]
) if judged else None

# %% [markdown]
# ## How large the cartilages are
# Length, width and thickness per subject, the mean of both sides, and the density of cartilage that is not calcified.
# No published table has these for the 2nd and 3rd rib. Everything is measured on the masks above and shares their
# faults: on slices of 5 mm a width is not known to better than a few millimetres.

# %%
measured = [measure_anatomy(one.image, one.mask, name) for name, one in people.items() if one.image is not None]
long = pd.concat(measured)
long["part"] = long["part"].str.replace(r"^(right|left)_", "rib ", regex=True)  # the mean of both sides
kept = long[long["quantity"].isin(["length", "width", "thickness"]) | (long["part"] == "cartilages")]
plain = {
    "density_mean": "density, mean",
    "density_sd": "density, SD",
    "calcified_share": "share calcified",
    "wall_curvature": "curve of the chest wall",
}
kept = kept.assign(quantity=kept["quantity"].replace(plain), unit=kept["unit"].replace({"1": ""}))
anatomy = kept.pivot_table(index=["part", "quantity", "unit"], columns="subject", values="value", sort=False)
anatomy[list(people)].round(2)

# %% [markdown]
# ## What this shows
# Every cloud has the number of points asked for, lies on its surface and holds all nine parts, and grown cartilage
# agrees with labelled cartilage within the targets of the study.

# %%
assert people, "expected at least one subject"
assert len(people) == sum(kind != "not yet" for kind in how.values()), "a subject with labels or landmarks was left out"
assert (clouds["points"] == params.ct_points).all(), f"expected {params.ct_points} points each, got {clouds['points']}"
# Open3D samples the triangles themselves; what is left is single precision.
assert (clouds["to the surface, at most (mm)"] < 0.05).all(), "points must lie on the surface"
assert (clouds["fewest points on a part"] >= 20).all(), "a part with fewer points cannot be cut into its waypoints"
lengths = anatomy.xs("length", level="quantity").drop("sternum", errors="ignore")
assert ((lengths > 15) & (lengths < 130)).all(axis=None), f"no cartilage 2-5 is that short or long:\n{lengths}"
if agreement is not None:
    assert agreement["Dice, all parts"] >= 0.80, f"expected a Dice of 0.80, got {agreement['Dice, all parts']:.2f}"
    assert agreement["surfaces apart, mean (mm)"] <= 1.5, f"expected 1.5 mm, got {agreement.iloc[1]:.2f} mm"
