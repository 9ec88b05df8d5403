"""Executed notebooks as pages that need nothing from a network."""

from __future__ import annotations

import html
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2
import nbformat
from nbconvert import HTMLExporter

from study.errors import StudyError

# The two forms of TeX that the notebooks use: a name, and a name with a subscript. All other text stays as it is.
_TEX = re.compile(r"\$([A-Za-z])(?:_(?:\{([A-Za-z0-9]+)\}|([A-Za-z0-9])))?\$")
_OUTSIDE_CODE = re.compile(r"(<pre.*?</pre>|<code.*?</code>)", re.DOTALL)


def notebook_page(path: Path, template: jinja2.Template) -> tuple[str, str]:
    """One executed notebook as a page: its title, and the page.

    Args:
        path: of the ``.ipynb``.
        template: with ``title``, ``body`` and ``style``.

    Raises:
        StudyError: a file that is no notebook.
    """
    try:
        notebook = nbformat.read(path, as_version=4)
    except (OSError, ValueError, AttributeError, nbformat.ValidationError) as error:
        told = " ".join(str(error).split())[:200]
        raise StudyError(f"expected a notebook at {path}, got: {told}; execute it again") from error
    _describe_images(notebook)
    exporter = HTMLExporter(  # type: ignore[no-untyped-call]
        template_name="basic", anchor_link_text="", exclude_input_prompt=True, exclude_output_prompt=True
    )
    body, resources = exporter.from_notebook_node(notebook)
    body = _in_a_page(body)
    title = title_of(notebook, path.stem)
    return title, template.render(title=title, stem=path.stem, body=body, style=_styles(resources))


def title_of(notebook: Any, otherwise: str) -> str:
    """The first heading, or ``otherwise``."""
    for cell in notebook.cells:
        heading = re.match(r"#\s+(.+)", cell.source) if cell.cell_type == "markdown" else None
        if heading:
            return heading[1].strip()
    return otherwise


def _describe_images(notebook: Any) -> None:
    """Give every picture a text in place of it: the heading that it stands under, unless it brings one of its own."""
    heading, number = "the notebook", 0
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            found = re.findall(r"^#+\s+(.+)$", cell.source, flags=re.MULTILINE)
            heading = found[-1].strip() if found else heading
            continue
        for output in cell.get("outputs", []):
            for kind in ("image/png", "image/svg+xml", "image/jpeg"):
                if kind in output.get("data", {}):
                    number += 1
                    about = output.setdefault("metadata", {}).setdefault(kind, {})
                    about.setdefault("alt", f"Figure {number}, of “{heading}”; the text and tables around it say what")


def _in_a_page(body: str) -> str:
    """Cells without links to a network's scripts, wide tables that scroll by themselves, and TeX names as text."""
    body = re.sub(r"<script\b.*?</script>", "", body, flags=re.DOTALL)  # widgets' and MathJax's loaders
    body = re.sub(
        r"(<table\b.*?</table>)",
        r'<div class="wide" tabindex="0" role="region" aria-label="table">\1</div>',
        body,
        flags=re.DOTALL,
    )
    parts = _OUTSIDE_CODE.split(body)
    return "".join(part if k % 2 else _TEX.sub(_name, part) for k, part in enumerate(parts))


def _name(found: re.Match[str]) -> str:
    below = found[2] or found[3]
    return f"<var>{html.escape(found[1])}{f'<sub>{html.escape(below)}</sub>' if below else ''}</var>"


def _styles(resources: Mapping[str, Any]) -> str:
    """Pygments' rules for highlighted code, without anything that would be loaded."""
    css = resources.get("inlining", {}).get("css", [])
    return "\n".join(
        line for sheet in css for line in sheet.splitlines() if ".highlight" in line and "url(" not in line
    )
