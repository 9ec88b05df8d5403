"""The manifest, the data folder and fetching: the only code that touches the network."""

from study.data.fetch import fetch, fetch_all
from study.data.manifest import default_manifest_path, load_manifest
from study.data.schema import Cohort, DataFile, Manifest, SubjectEntry
from study.data.store import data_dir, data_list, path_of, status, verify, verify_all

__all__ = [
    "Cohort",
    "DataFile",
    "Manifest",
    "SubjectEntry",
    "data_dir",
    "data_list",
    "default_manifest_path",
    "fetch",
    "fetch_all",
    "load_manifest",
    "path_of",
    "status",
    "verify",
    "verify_all",
]
