"""The one reader of YAML: what would be read otherwise than it looks, or would never end, is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from study.errors import StudyError

LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the same YAML, read ten times faster where libyaml is
MAX_BYTES = 16 << 20
MAX_DEPTH = 32
MAX_TOLD = 20  # faults in one message
MAX_NODES = 200_000  # after aliases are followed; the study's own manifest has some 2,000

Fault = tuple[tuple[Any, ...], str]


def read_yaml(path: Path, where: str | None = None) -> tuple[Any, yaml.Node | None]:
    """Read one YAML document.

    Args:
        path: the file.
        where: what messages call it; the file's name when None.

    Returns:
        its content, and its nodes, which know their lines.

    Raises:
        OSError: the file cannot be read.
        StudyError: not UTF-8, not YAML, more than a document of this project can be, nested too deep, or aliases that
            loop or grow without end.
    """
    where = where or path.name
    if (n_bytes := path.stat().st_size) > MAX_BYTES:
        raise StudyError(f"{where}: expected a text of at most {MAX_BYTES} bytes, got {n_bytes}; is this another file?")
    try:
        text = path.read_text(encoding="utf-8")
        _check_growth(text, where)
        root = yaml.compose(text, Loader=LOADER)
        return yaml.load(text, Loader=LOADER), root
    except StudyError:
        raise
    except (yaml.YAMLError, ValueError, TypeError) as error:  # dates and numbers that are none are ValueErrors
        reason = " ".join(str(error).split())[:300]
        raise StudyError(f"{where}: expected YAML in UTF-8, got {reason}; mend the file") from error


def repeated_keys(node: yaml.Node | None, at: tuple[Any, ...] = ()) -> list[Fault]:
    """Keys that stand twice in one mapping, of which YAML would silently keep the last, and keys that are no text."""
    faults: list[Fault] = []
    if isinstance(node, yaml.MappingNode):
        seen: set[Any] = set()
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                faults.append((at, "expected keys of text, got a list or mapping as one; mend it"))
                continue
            same = _key(key)
            if same in seen:
                faults.append(((*at, key.value), "expected the key once, got it twice; delete one"))
            seen.add(same)
            faults += repeated_keys(value, (*at, key.value))
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            faults += repeated_keys(value, (*at, index))
    return faults


def line_of(node: yaml.Node | None, at: tuple[Any, ...]) -> str:
    """``" (line 41)"`` of the deepest key on the way to ``at`` that stands in the file."""
    line = 0
    for step in at:
        pairs: list[tuple[Any, yaml.Node, yaml.Node]] = []
        if isinstance(node, yaml.MappingNode):
            pairs = [(key.value, key, value) for key, value in node.value]
        elif isinstance(node, yaml.SequenceNode):
            pairs = [(str(index), value, value) for index, value in enumerate(node.value)]
        match = next(((mark, value) for name, mark, value in pairs if name == str(step)), None)
        if match is None:
            break
        line, node = match[0].start_mark.line + 1, match[1]
    return f" (line {line})" if line else ""


def located(faults: list[Fault], root: yaml.Node | None, where: str) -> StudyError:
    """The faults as one line, each at its key and the line of that."""
    count = f"{len(faults)} faults: " if len(faults) > 1 else ""
    told = [f"{'.'.join(map(str, at)) or 'top level'}{line_of(root, at)}: {what}" for at, what in faults[:MAX_TOLD]]
    more = [f"and {len(faults) - MAX_TOLD} more"] if len(faults) > MAX_TOLD else []
    return StudyError(f"{where}: {count}{'; '.join([*told, *more])}")


def _key(node: yaml.ScalarNode) -> Any:
    """What a key is once read: 116 and 0x74 are one."""
    try:
        return yaml.constructor.SafeConstructor().construct_object(node)
    except yaml.YAMLError:  # the merge key
        return node.value


def _check_growth(text: str, where: str) -> None:
    """Count nodes and depth as they will be once aliases are followed, in one pass that follows none."""
    grown: dict[str, tuple[int, int]] = {}  # nodes and depth below an anchor
    open_nodes: list[list[Any]] = [[None, 0, 0]]  # anchor, nodes, depth below
    for event in yaml.parse(text, Loader=LOADER):
        line = event.start_mark.line + 1 if event.start_mark else 0
        match event:
            case yaml.CollectionStartEvent():
                open_nodes.append([event.anchor, 1, 1])
                n_nodes, depth, anchor = 0, 0, None
            case yaml.CollectionEndEvent():
                anchor, n_nodes, depth = open_nodes.pop()
            case yaml.ScalarEvent():
                anchor, n_nodes, depth = event.anchor, 1, 0
            case yaml.AliasEvent():
                if any(event.anchor == above for above, *_ in open_nodes):
                    raise StudyError(
                        f"{where} (line {line}): expected aliases of what is complete, got *{event.anchor} inside"
                        f" &{event.anchor} itself, a loop; write it out"
                    )
                anchor, (n_nodes, depth) = None, grown.get(str(event.anchor), (1, 0))
            case _:
                continue
        if anchor is not None:
            grown[anchor] = n_nodes, depth
        parent = open_nodes[-1]
        parent[1] += n_nodes
        parent[2] = max(parent[2], depth + 1 if n_nodes else 0)
        if len(open_nodes) + depth > MAX_DEPTH:
            raise StudyError(
                f"{where} (line {line}): expected at most {MAX_DEPTH} levels, got more: nested too deep, flatten it"
            )
        if parent[1] > MAX_NODES:
            raise StudyError(
                f"{where} (line {line}): expected at most {MAX_NODES} values, got more once its aliases are followed;"
                " write them out"
            )
