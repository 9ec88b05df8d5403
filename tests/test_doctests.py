"""The examples of the front door run as they are printed."""

import doctest
from importlib import import_module

import pytest

FRONT_DOOR = (
    "study.pipeline",
    "study.methods",
    "study.registration",
    "study.ultrasound.cloud",
    "study.files.plus",
)


@pytest.mark.parametrize("name", FRONT_DOOR)
def test_examples_run_as_printed(name):
    result = doctest.testmod(import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert result.attempted > 0, f"{name}: expected examples, got none"
    assert result.failed == 0
