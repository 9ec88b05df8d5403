"""Where the configured package index keeps a file; the file is read, none of the package's code is run."""

from __future__ import annotations

import configparser
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit, urlunsplit

from platformdirs import site_config_path, user_config_path
from pypi_simple import PYPI_SIMPLE_ENDPOINT, NoSuchProjectError, PyPISimple, UnsupportedContentTypeError

from study.data.web import Web, reported, shown
from study.errors import StudyError


def index_url() -> str:
    """The package index this machine is set up to use.

    In order: ``PIP_INDEX_URL``, ``UV_DEFAULT_INDEX``, ``UV_INDEX_URL``, ``index-url`` of pip's configuration
    files (the most specific wins), the public index.
    """
    for variable in ("PIP_INDEX_URL", "UV_DEFAULT_INDEX", "UV_INDEX_URL"):
        if url := os.environ.get(variable, "").strip():
            return url
    config = configparser.RawConfigParser(strict=False)
    try:
        config.read(_pip_config_files(), encoding="utf-8")
    except (configparser.Error, UnicodeDecodeError) as error:
        raise StudyError(
            f"expected a readable pip configuration, got {error}; correct it or set PIP_INDEX_URL"
        ) from error
    return config.get("global", "index-url", fallback="").strip() or PYPI_SIMPLE_ENDPOINT


def _pip_config_files() -> Iterator[Path]:
    """Pip's configuration files, least specific first, as pip reads them."""
    chosen = os.environ.get("PIP_CONFIG_FILE")
    if chosen == os.devnull:
        return
    yield site_config_path("pip", appauthor=False) / "pip.conf"
    yield Path("/etc/pip.conf")
    yield Path.home() / ".pip" / "pip.conf"
    yield user_config_path("pip", appauthor=False) / "pip.conf"
    yield Path.home() / ".config" / "pip" / "pip.conf"
    yield Path(sys.prefix) / "pip.conf"
    if chosen:
        yield Path(chosen)


def file_url(project: str, archive: str, sha256: str, web: Web) -> str:
    """The address of one file of a project on the configured index.

    Raises:
        StudyError: the index cannot be asked, or lacks the project or the file, or holds a file of that name with
            another sha256.
    """
    index = index_url()
    with reported(index), PyPISimple(index, session=web.session) as client:
        try:
            page = client.get_project_page(project, timeout=web.timeout_s)
        except NoSuchProjectError as error:
            raise StudyError(
                f"{shown(index)}: expected the project {project!r}, got none; set PIP_INDEX_URL to an index that has it"
            ) from error
        except UnsupportedContentTypeError as error:
            raise StudyError(f"{shown(index)}: expected a package index, got {error}; check PIP_INDEX_URL") from error
    package = next((each for each in page.packages if each.filename == archive), None)
    if package is None:
        raise StudyError(
            f"{shown(index)}: expected the file {archive!r} of {project!r}, got {len(page.packages)} other files; "
            "set PIP_INDEX_URL to an index that has it"
        )
    published = package.digests.get("sha256", sha256)
    if published != sha256:
        raise StudyError(
            f"{shown(index)}: expected {archive} with sha256 {sha256}, got {published}; "
            "this is another file, not fetched"
        )
    return _with_login(package.url, index)


def _with_login(url: str, index: str) -> str:
    """The file's address with the index's user name and password, on the index's own host only."""
    login, at, host = urlsplit(index).netloc.rpartition("@")
    parts = urlsplit(url)
    return urlunsplit(parts._replace(netloc=f"{login}@{host}")) if at and parts.netloc == host else url
