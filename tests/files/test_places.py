"""The package finds its own files in a checkout and once installed."""

from __future__ import annotations

from pathlib import Path

import pytest

from study.files import places


def test_a_checkout_serves_its_own_files() -> None:
    root = Path(__file__).parents[2]
    assert places.is_checkout()
    assert places.shipped("data_manifest.yaml") == root / "data_manifest.yaml"
    assert places.shipped("annotations").is_dir()


def test_an_installed_package_serves_the_files_inside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places, "PACKAGE", tmp_path / "site-packages" / "study")
    monkeypatch.setattr(places, "CHECKOUT", tmp_path)
    (tmp_path / "data_manifest.yaml").touch()  # somebody's own file above the installation is not ours
    assert not places.is_checkout()
    assert places.shipped("annotations") == tmp_path / "site-packages" / "study" / "shipped" / "annotations"
