"""The draft of a manifest for a folder of CTs of one's own."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import yaml

from study.errors import StudyError

SUFFIXES = (".nii.gz", ".nii", ".nrrd", ".nhdr", ".mha", ".mhd")
LANDMARKS = (".yaml", ".mrk.json", ".fcsv")
LABELS = re.compile(r"(?P<who>.*?)[-_. ]?(labels?|seg|segmentations?|masks?|parts)", re.IGNORECASE)
MASKS = "sternum"  # a folder that holds such a file is TotalSegmentator's

HEAD = """\
# A cohort of one's own, drafted from {folder}. Look it over, then:
#   study data verify --dataset {name}    every file is here
#   study run --dataset {name}            every CT to every other person's simulated sweep
# Paths are relative to this file. The forms that data_manifest.yaml of the study uses (downloads, hashes, licences,
# rib labels only) serve here, too.

"""
COHORT = """\
cohorts:
  # The name of the data set in tables and folders: change it as you like.
  {key}:
    title: {title}
    subjects:
"""


@dataclass(frozen=True)
class _Found:
    """One CT of the folder; paths are relative to the manifest.

    Attributes:
        labels: a label volume, or the pattern of a folder of masks.
        landmarks: a landmark file; where there are neither labels nor this, the one that is still to be made.
    """

    key: str
    ct: str
    labels: str | None
    landmarks: str | None
    absent: bool


def draft_manifest(folder: Path, out: Path) -> tuple[str, list[str]]:
    """A commented manifest of the CTs below a folder.

    A CT is a file, or a folder of a DICOM series or with a ``ct`` file in it. What cuts it is beside it: a label volume
    (``anna_labels.nii.gz`` or ``labels.nii.gz``), TotalSegmentator's folder of masks, or a landmark file
    (``anna.yaml``, ``anna.mrk.json``). A CT with none gets the name of a landmark file that is not there yet.

    Args:
        folder: to look in, two folders deep.
        out: where the manifest will be; paths are relative to its folder.

    Returns:
        the text, and the keys of the subjects without labels or landmarks.

    Raises:
        StudyError: no such folder, or no CT in it.
    """
    if not folder.is_dir():
        raise StudyError(f"expected a folder of CTs at {folder}, got none; check the path")
    top, base = folder.resolve(), out.resolve().parent
    found = [*_in_files(top, base), *(one for sub in _folders(top) for one in _in_folder(sub, base))]
    if not found:
        raise StudyError(
            f"{folder}: expected CTs ({', '.join(SUFFIXES)}, or a folder of DICOM files each), got none; "
            "give the folder that holds them"
        )
    keys = [one.key for one in found]
    if twice := sorted({key for key in keys if keys.count(key) > 1}):
        raise StudyError(f"{folder}: expected a name of its own for each CT, got {', '.join(twice)} twice; rename one")
    text = HEAD.format(folder=folder.name or folder, name=out.name) + "files:\n"
    for one in found:
        text += _file(f"{one.key}_ct", "ct", one.ct, "the image, Hounsfield units")
        if one.labels:
            text += _file(f"{one.key}_labels", "labels", one.labels, "on the image's grid")
    text += "\n" + COHORT.format(key=_key(folder.resolve().name), title=_scalar(f"CTs of {folder.resolve().name}"))
    text += "".join(_subject(one) for one in found)
    return text, [one.key for one in found if one.absent]


def _file(key: str, role: str, path: str, what: str) -> str:
    return f"  {key}:  # {what}\n    role: {role}\n    source: {{kind: local, path: {_scalar(path)}}}\n"


def _subject(one: _Found) -> str:
    text = f"      {one.key}:\n        ct: {one.key}_ct\n"
    if one.labels:
        text += "        # Names of the label ids: another map can stand under label_maps of this file.\n"
        text += f"        labels: {{file: {one.key}_labels, map: totalsegmentator_v2}}\n"
    if one.landmarks:
        note = "  # not there yet: `study landmarks` helps to make it" if one.absent else ""
        text += f"        landmarks: {_scalar(one.landmarks)}{note}\n"
    return text


def _folders(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))


def _in_files(folder: Path, base: Path) -> list[_Found]:
    """CTs that are files of a folder, each with a name of its own."""
    images = {stem: path for path in sorted(folder.iterdir()) if path.is_file() and (stem := _stem(path, SUFFIXES))}
    labels = {
        match["who"].lower(): path
        for stem, path in images.items()
        if (match := LABELS.fullmatch(stem)) and match["who"]
    }
    return [
        _found(stem, path, labels.get(stem.lower()), _landmarks(folder, stem), base)
        for stem, path in images.items()
        if path not in labels.values()
    ]


def _in_folder(folder: Path, base: Path) -> list[_Found]:
    """The CT of a folder of its own: a ``ct`` file, the only image that is no label volume, or a DICOM series."""
    images = {stem: path for path in sorted(folder.iterdir()) if path.is_file() and (stem := _stem(path, SUFFIXES))}
    labels = [path for stem, path in images.items() if LABELS.fullmatch(stem)]
    masks = [
        sub / f"{{structure}}{suffix}"
        for sub in _folders(folder)
        for suffix in SUFFIXES
        if (sub / (MASKS + suffix)).is_file()
    ]
    others = {stem: path for stem, path in images.items() if path not in labels}
    ct = others.get("ct") or (next(iter(others.values())) if len(others) == 1 else None) or _series(folder)
    if ct is None:
        return []
    cut = [*labels, *masks]
    marked = (
        _landmarks(folder, "landmarks") or _landmarks(folder.parent, folder.name) or _landmarks(folder, folder.name)
    )
    return [_found(folder.name, ct, cut[0] if cut else None, marked, base)]


def _series(folder: Path) -> Path | None:
    """The folder that holds DICOM files: itself, or the only one in it."""
    holding = [place for place in (folder, *_folders(folder)) if any(_is_dicom(path) for path in place.iterdir())]
    return holding[0] if len(holding) == 1 else None


def _is_dicom(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(132)[128:] == b"DICM"


def _stem(path: Path, suffixes: tuple[str, ...]) -> str | None:
    suffix = next((suffix for suffix in suffixes if path.name.lower().endswith(suffix)), None)
    return path.name[: -len(suffix)] or None if suffix else None


def _landmarks(folder: Path, stem: str) -> Path | None:
    return next((path for suffix in LANDMARKS if (path := folder / f"{stem}{suffix}").is_file()), None)


def _found(name: str, ct: Path, labels: Path | None, landmarks: Path | None, base: Path) -> _Found:
    key = _key(name)
    absent = labels is None and landmarks is None
    marked = (
        f"{key}.yaml" if absent else None if landmarks is None or labels is not None else _relative(landmarks, base)
    )
    return _Found(key, _relative(ct, base), None if labels is None else _relative(labels, base), marked, absent)


def _relative(path: Path, base: Path) -> str:
    return path.relative_to(base).as_posix() if path.is_relative_to(base) else path.as_posix()


def _key(name: str) -> str:
    """A name of letters, digits, '.', '_' and '-', as the manifest's keys are."""
    return re.sub(r"^[^A-Za-z0-9]+", "", re.sub(r"[^A-Za-z0-9._-]+", "-", name)) or "subject"


def _scalar(text: str) -> str:
    """Text as YAML writes it on one line."""
    return yaml.safe_dump(text, default_style='"', allow_unicode=True, width=10_000).strip()
