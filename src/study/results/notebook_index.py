"""The page that lists the executed notebooks of a folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jinja2

from study.files.atomic import write_text

RECORD = "study"  # key of a notebook's metadata: what it was executed with, how it ended, how long it took
INDEX = "index.html"

_PAGE = """\
<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Executed notebooks</title>
<style>
body { font: 16px/1.5 sans-serif; margin: 2em auto; max-width: 60em; padding: 0 1em; color: #222 }
div { overflow-x: auto }
table { border-collapse: collapse; width: 100% }
th, td { text-align: left; padding: .3em .8em .3em 0; border-bottom: 1px solid #ccc; vertical-align: top }
.number { text-align: right; font-variant-numeric: tabular-nums }
.failed { color: #b2182b; font-weight: bold }
</style>
<h1>Executed notebooks</h1>
<p>Executed: {{ rows | length }}; failed: {{ n_failed }}; {{ "%.0f" | format(seconds) }} s in all. Times are UTC.</p>
<div><table>
<thead><tr><th>Notebook<th>Parameters<th class="number">Seconds<th>Started<th>State</tr></thead>
<tbody>
{%- for row in rows %}
<tr><td><a href="{{ row.file | urlencode }}">{{ row.name }}</a>
<td>{{ row.parameters }}
<td class="number">{{ "%.1f" | format(row.seconds) }}
<td>{{ row.started }}
<td>{% if row.fault %}<span class="failed">failed</span>: {{ row.fault }}{% else %}{{ row.state }}{% endif %}</tr>
{%- endfor %}
</tbody>
</table></div>
</html>
"""


def record_of(path: Path) -> dict[str, Any] | None:
    """What an executed notebook says of its execution; None of a file that is not there or says nothing."""
    try:
        return dict(json.loads(path.read_text(encoding="utf-8"))["metadata"][RECORD])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def executed_in(folder: Path) -> list[dict[str, Any]]:
    """What is known of each executed notebook of a folder, by name: see `RECORD`; ``file`` and ``name`` are added."""
    found = {path: record_of(path) for path in sorted(folder.glob("*.ipynb"))}
    return [{**record, "file": path.name, "name": path.stem} for path, record in found.items() if record is not None]


def write_index(folder: Path) -> Path:
    """Write the page beside the notebooks; where it is."""
    rows = executed_in(folder)
    for row in rows:
        row["parameters"] = ", ".join(
            f"{name} {'all' if value == '' else value}" for name, value in row["parameters"].items()
        )
        row["started"] = (row["started"] or "")[:19].replace("T", " ")
    page = jinja2.Environment(autoescape=True).from_string(_PAGE)
    n_failed = sum(row["state"] == "failed" for row in rows)
    seconds = sum(row["seconds"] for row in rows)
    write_text(folder / INDEX, page.render(rows=rows, n_failed=n_failed, seconds=seconds))
    return folder / INDEX
