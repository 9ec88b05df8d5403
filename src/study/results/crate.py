"""``ro-crate-metadata.json``: what a run's folder holds and what made it, as a Process Run Crate.

RO-Crate 1.1 with the profile Process Run Crate 0.5, https://w3id.org/ro/wfrun/process/0.5. Everything in it is of the
folder's provenance, so two runs differ in its dates alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

from study.files.atomic import json_text, sha256_of, write_json, write_text
from study.results.claim import PROVENANCE

CRATE = "ro-crate-metadata.json"
PROFILE = "https://w3id.org/ro/wfrun/process/0.5"
SPECIFICATION = "https://w3id.org/ro/crate/1.1"
LICENCE = "https://spdx.org/licenses/MIT"

_FORMATS = {
    ".csv": "text/csv",
    ".json": "application/json",
    ".md": "text/markdown",
    ".tex": "application/x-tex",
    ".png": "image/png",
    ".svg": "image/svg+xml",
    ".yaml": "application/yaml",
    ".ipynb": "application/x-ipynb+json",
}
_TOLD = {
    "metrics.csv": "every number of every case",
    "timings.csv": "seconds of every step",
    "provenance.json": "code, inputs, versions, machine, times and the SHA-256 of every file",
    "parameters.json": "every parameter of the study and of each method",
    "manifest.yaml": "where the input files come from",
    "environment.lock": "exact versions of all packages",
    "failures.log": "where in the code cases failed",
}
_TIMED = ("timings.csv", PROVENANCE)  # of no size of their own: it changes from run to run


def seal(folder: Path, names: Iterable[str], provenance: Mapping[str, Any]) -> None:
    """Describe the files of a run, and hold them to what they are now by their hashes: the crate, then provenance.

    Args:
        folder: of the run.
        names: of its files, without provenance.
        provenance: of the run; the hashes are added.
    """
    files = sorted({*names} - {CRATE})
    write_text(folder / CRATE, crate_text(folder, files, provenance))
    hashes = {name: sha256_of(folder / name) for name in (*files, CRATE)}
    write_json({**provenance, "files_sha256": hashes}, folder / PROVENANCE)


def crate_text(folder: Path, names: Iterable[str], record: Mapping[str, Any]) -> str:
    """The metadata of a run's folder.

    Args:
        folder: of the run.
        names: of its files, beside the crate and provenance; notebooks in it are found.
        record: its provenance.
    """
    notebooks = (path.relative_to(folder).as_posix() for path in folder.rglob("*.ipynb"))
    files = [_file(folder, name) for name in sorted({*names, *notebooks, PROVENANCE})]
    given = [{"@id": name} for name in ("parameters.json", "manifest.yaml", "environment.lock") if name in {*names}]
    values = [
        {"@id": f"#{name}", "@type": "PropertyValue", "name": name, "value": record[name]}
        for name in ("dataset", "seed")
    ]
    inputs = [
        {"@id": f"#input/{quote(name)}", "@type": "CreativeWork", "name": name, "identifier": f"sha256:{sha256}"}
        for name, sha256 in sorted(record["inputs_sha256"].items())
    ]
    results = [{"@id": file["@id"]} for file in files if {"@id": file["@id"]} not in given]
    action = {
        "@id": "#run",
        "@type": "CreateAction",
        "name": f"study run --dataset {record['dataset']} --seed {record['seed']}",
        "description": f"{len(record['parameters'].get('methods', ()))} methods; `study rerun` repeats it",
        "startTime": record["started"],
        "endTime": record["finished"],
        "actionStatus": "http://schema.org/CompletedActionStatus",
        "agent": {"@id": "#authors"},
        "instrument": {"@id": "#study"},
        "object": [*given, *({"@id": entity["@id"]} for entity in (*values, *inputs))],
        "result": results,
    }
    return json_text(
        {
            "@context": f"{SPECIFICATION}/context",
            "@graph": [_descriptor(), _root(record, files), action, *_makers(record), *values, *inputs, *files],
        }
    )


def _descriptor() -> dict[str, Any]:
    conforms = {"conformsTo": {"@id": SPECIFICATION}, "about": {"@id": "./"}}
    return {"@id": CRATE, "@type": "CreativeWork", **conforms}


def _root(record: Mapping[str, Any], files: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    return {
        "@id": "./",
        "@type": "Dataset",
        "name": f"Run of {record['dataset']} at seed {record['seed']}",
        "description": "Ultrasound-CT registrations of costal cartilage: one data set, every pair, every method.",
        "datePublished": record["finished"],
        "license": {"@id": LICENCE},
        "author": {"@id": "#authors"},
        "publisher": {"@id": "#authors"},
        "conformsTo": {"@id": PROFILE},
        "hasPart": [{"@id": file["@id"]} for file in files],
        "mentions": {"@id": "#run"},
    }


def _makers(record: Mapping[str, Any]) -> list[dict[str, Any]]:
    versions = record["versions"]
    return [
        {"@id": PROFILE, "@type": "CreativeWork", "name": "Process Run Crate", "version": "0.5"},
        {"@id": LICENCE, "@type": "CreativeWork", "name": "MIT", "description": "MIT licence"},
        {"@id": "#authors", "@type": "Organization", "name": "the study authors"},
        {
            "@id": "#study",
            "@type": "SoftwareApplication",
            "name": "thoracic-cartilage-study",
            "softwareVersion": versions.get("thoracic-cartilage-study", "unknown"),
            "identifier": f"sha256:{record['code_sha256']}",
            "softwareRequirements": ", ".join(f"{name} {version}" for name, version in sorted(versions.items())),
        },
    ]


def _file(folder: Path, name: str) -> dict[str, Any]:
    path = folder / name
    entity = {
        "@id": quote(name),
        "@type": "File",
        "name": name,
        "encodingFormat": _FORMATS.get(path.suffix, "text/plain"),
    }
    if name in _TOLD:
        entity["description"] = _TOLD[name]
    if name not in _TIMED:
        entity["contentSize"] = str(path.stat().st_size)
    return entity
