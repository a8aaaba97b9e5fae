"""The patches that make a document say another scene, remove an object from it, or add a copy of one."""

from __future__ import annotations

import json
import re

import yaml

from mjx_refine.edit.document import (
    Document,
    Patch,
    Path,
    content_end,
    find,
    is_null,
    number_text,
    scene_leaves,
    vector_text,
)
from mjx_refine.errors import InputError
from mjx_refine.scene import Scene

_PLAIN_NAME = re.compile(r"[A-Za-z_][\w-]*")
_YAML_WORDS = {"y", "n", "yes", "no", "on", "off", "true", "false", "null"}


def rewritten(document: Document, wanted: Scene) -> str:
    """The text that says ``wanted``, which has the document's objects in its order; only changed numbers change.

    Raises:
      InputError: a value that changes is shared by an alias or merged in from elsewhere.
    """
    patches: list[Patch] = []
    nodes = [*document.object_nodes(), *(_entry(document, kind) for kind in ("camera", "gravity"))]
    before, after = scene_leaves(document.scene), scene_leaves(wanted)
    for node, old, new in zip(nodes, before, after, strict=False):
        changed = {path: value for path, value in new.items() if value != old[path]}
        if not changed:
            continue
        if node is None:
            patches.append(_new_gravity(document, wanted))
            continue
        missing: dict[str, dict[str, str]] = {}
        for path, value in changed.items():
            patches += _changed_value(document, node, path, old[path], value, missing)
        for section, values in missing.items():
            patches.append(_inserted(document, node, section, values))
    return document.patched(patches)


def _entry(document: Document, kind: str) -> yaml.MappingNode | None:
    return next((node for name, node in document.entries() if name == kind), None)


def _changed_value(
    document: Document, entry: yaml.MappingNode, path: Path, old, new, missing: dict[str, dict[str, str]]
) -> list[Patch]:
    """Patches of one value; where there is none in the text, it is noted in ``missing`` by its section."""
    node: yaml.Node | None = entry
    for key in path:
        _refuse_shared(document, node, path)
        node = None if node is None else find(node, key)
    if node is None or is_null(node):
        *section, key = (str(part) for part in path)
        text = vector_text(tuple(new)) if isinstance(new, list) else number_text(new)
        missing.setdefault(section[0] if section else "", {})[key] = text
        return []
    if not isinstance(new, list):
        return [_number(document, node, path, new)]
    pairs = list(zip(node.value, old, new, strict=True))
    _refuse_shared(document, node, path)
    return [_number(document, item, path, value) for item, was, value in pairs if value != was]


def _refuse_shared(document: Document, node: yaml.Node | None, path: Path) -> None:
    merged = isinstance(node, yaml.MappingNode) and any(key.tag == "tag:yaml.org,2002:merge" for key, _ in node.value)
    if merged or id(node) in document.shared:
        line = (node.start_mark.line if node else 0) + 1
        raise InputError(
            f"{document.source}: {'.'.join(map(str, path))} (line {line} of the scene) is shared by an alias or a merge; "
            "expected a value of its own; write it out"
        )


def _number(document: Document, node: yaml.Node, path: Path, value: float) -> Patch:
    _refuse_shared(document, node, path)
    start, end = node.start_mark.index, node.end_mark.index
    return Patch(start, end, number_text(value, document.yaml[start:end]))


def _inserted(document: Document, entry: yaml.MappingNode, section: str, values: dict[str, str]) -> Patch:
    """Keys added to a section of an entry, or to the entry itself where the section is ""."""
    node = find(entry, section) if section else entry
    if isinstance(node, yaml.MappingNode) and node.value:
        null = next((value for key, value in node.value if key.value in values and is_null(value)), None)
        if null is not None:
            raise InputError(
                f"{document.source}: line {null.start_mark.line + 1} of the scene has a key without a value; expected a "
                "number; write it, or remove the key"
            )
        return _appended(document, node, values)
    inside = "{" + ", ".join(f"{_word(document, key)}: {text}" for key, text in values.items()) + "}"
    if node is None:
        return _appended(document, entry, {section: inside})
    start, end = node.start_mark.index, node.end_mark.index
    return Patch(start, end, inside if start < end else f" {inside}")


def _appended(document: Document, node: yaml.MappingNode, values: dict[str, str]) -> Patch:
    """Keys at the end of a mapping that is not empty, in its own style."""
    _refuse_shared(document, node, tuple(values))
    end = content_end(node.value[-1][1])
    if node.flow_style:
        return Patch(end, end, "".join(f", {_word(document, key)}: {text}" for key, text in values.items()))
    at = line_end(document.yaml, end)
    indent = " " * node.value[0][0].start_mark.column
    return Patch(at, at, "".join(f"\n{indent}{key}: {text}" for key, text in values.items()))


def line_end(text: str, at: int) -> int:
    """Where the line of ``at`` ends, before its line feed."""
    end = text.find("\n", at)
    return len(text) if end < 0 else end


def _new_gravity(document: Document, wanted: Scene) -> Patch:
    gravity = vector_text(wanted.gravity)
    if document.root.flow_style:
        end = content_end(document.root.value[-1])
        kind, word = _word(document, "type"), _word(document, "gravity")
        return Patch(end, end, f", {{{kind}: {word}, {word}: {gravity}}}")
    at = line_end(document.yaml, content_end(document.root.value[-1]))
    indent = " " * document.root.start_mark.column
    return Patch(at, at, f"\n{indent}- type: gravity\n{indent}  gravity: {gravity}")


def _word(document: Document, word: str) -> str:
    """A key or type as the text writes them: JSON has them in quotation marks."""
    first = document.root.value[0].value[0][0]
    return json.dumps(word) if first.style == '"' else word


def _block_span(document: Document, node: yaml.MappingNode) -> tuple[int, int]:
    """From the start of the line of an entry's dash to the end of its last line, the line feed included."""
    text = document.yaml
    dash = text.rfind("-", 0, node.start_mark.index)
    start = text.rfind("\n", 0, dash) + 1
    if dash < 0 or text[dash + 1 : node.start_mark.index].strip() or text[start:dash].strip():
        raise InputError(
            f"{document.source}: line {node.start_mark.line + 1} of the scene: an entry that does not begin with its dash; "
            "expected `- type: ...`; write it so"
        )
    return start, min(line_end(text, content_end(node)) + 1, len(text))


def without(document: Document, name: str) -> str:
    """The text without an object's entry; comments around it stay."""
    index = document.scene.names.index(name)
    node = document.object_nodes()[index]
    if not document.root.flow_style:
        return document.patched([Patch(*_block_span(document, node), "")])
    items = document.root.value
    at = items.index(node)
    if at + 1 < len(items):
        return document.patched([Patch(node.start_mark.index, items[at + 1].start_mark.index, "")])
    return document.patched(
        [Patch(items[at - 1].end_mark.index if at else node.start_mark.index, node.end_mark.index, "")]
    )


def with_copy(document: Document, name: str, new: str) -> str:
    """The text with a copy of an object's entry right behind it, under the name ``new``.

    Raises:
      InputError: the entry has anchors, which cannot stand twice.
    """
    index = document.scene.names.index(name)
    node = document.object_nodes()[index]
    shown = (
        new if _PLAIN_NAME.fullmatch(new) and new.lower() not in _YAML_WORDS else json.dumps(new, ensure_ascii=False)
    )
    flow = bool(document.root.flow_style)
    start, end = (node.start_mark.index, node.end_mark.index) if flow else _block_span(document, node)
    if any(id(child) in document.shared for child in _inside(node)):
        raise InputError(
            f"{document.source}: {name} holds anchors or aliases, which cannot be copied; write the values out"
        )
    named = find(node, "name")
    if isinstance(named, yaml.ScalarNode) and named.style == '"':
        shown = json.dumps(new, ensure_ascii=False)
    text = document.yaml[start:end]
    if named is None:
        first = node.value[0][0].start_mark
        text = _spliced(text, first.index - start, first.index - start, f"name: {shown}, " if node.flow_style else
                        f"name: {shown}\n{' ' * first.column}")  # fmt: skip
    else:
        text = _spliced(text, named.start_mark.index - start, named.end_mark.index - start, shown)
    if flow:
        return document.patched([Patch(end, end, f", {text}")])
    return document.patched([Patch(end, end, text if document.yaml[start:end].endswith("\n") else f"\n{text}")])


def _spliced(text: str, start: int, end: int, piece: str) -> str:
    return text[:start] + piece + text[end:]


def _inside(node: yaml.Node) -> list[yaml.Node]:
    children = node.value if isinstance(node, yaml.CollectionNode) else []
    flat = [part for child in children for part in (child if isinstance(child, tuple) else (child,))]
    return [node, *(inner for child in flat for inner in _inside(child))]
