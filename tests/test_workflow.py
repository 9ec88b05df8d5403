"""What runs elsewhere: actions are pinned to commits, and the commands of the workflow exist."""

import re
from pathlib import Path

import click
import pytest
import yaml

from study.cli import cli

ROOT = Path(__file__).parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
STEPS = [
    step
    for path in WORKFLOWS
    for job in yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"].values()
    for step in job["steps"]
]


def test_every_action_is_pinned_to_a_commit() -> None:
    actions = [step["uses"] for step in STEPS if "uses" in step]
    assert len(actions) > 5
    assert [action for action in actions if not re.fullmatch(r"[\w./-]+@[0-9a-f]{40}", action)] == []


@pytest.mark.parametrize("command", ["compare"])
def test_options_of_the_commands_that_it_runs_exist(command: str) -> None:
    run = next(step["run"] for step in STEPS if f"study {command} " in step.get("run", ""))
    known = {option for parameter in cli.commands[command].params for option in parameter.opts}
    assert isinstance(cli.commands[command], click.Command)
    assert set(re.findall(r"--[a-z]+", run)) <= known


def test_scripts_that_it_runs_are_here() -> None:
    scripts = {name for step in STEPS for name in re.findall(r"[\w./]+\.(?:py|sh)|\.ci/run", step.get("run", ""))}
    assert {".ci/run", "tools/newest.py"} <= scripts
    assert all((ROOT / name).is_file() for name in scripts)
