"""A scene file as text with positions: values are changed where they stand, and every other byte stays."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator

import yaml

from mjx_refine.errors import InputError
from mjx_refine.scene import SHAPES, Scene, parse_scenes, scene_entries
from mjx_refine.scene.text import sample_texts

_INTEGER = re.compile(r"[-+]?\d+")
Path = tuple[str | int, ...]


@dataclasses.dataclass(frozen=True)
class Patch:
    """``text`` in place of the characters from ``start`` to ``end``."""

    start: int
    end: int
    text: str


@dataclasses.dataclass(frozen=True)
class Document:
    """A text that holds one scene.

    Attributes:
      text: the whole file, thoughts, fences and comments included.
      source: its name in errors.
      scene: what it says.
      places: for each character of the scene's own YAML, its index in ``text``; one more for the end.
      root: the YAML's nodes.
      shared: ids of the nodes to which an alias refers, and of those inside them.
    """

    text: str
    source: str
    scene: Scene
    places: tuple[int, ...]
    root: yaml.SequenceNode
    shared: frozenset[int]

    @property
    def yaml(self) -> str:
        """The scene's own text, with plain line ends."""
        return "".join("\n" if self.text[k] == "\r" else self.text[k] for k in self.places[:-1])

    def patched(self, patches: list[Patch]) -> str:
        """The whole text with the patches, whose indices are the YAML's; those at one place keep their order."""
        line = "\r\n" if "\r\n" in self.text else "\n"
        text = self.text
        for patch in reversed(sorted(patches, key=lambda p: p.start)):
            start, end = (self._in_text(k) for k in (patch.start, patch.end))
            text = text[:start] + patch.text.replace("\n", line) + text[end:]
        return text

    def _in_text(self, index: int) -> int:
        """Where a character of the YAML stands; of a line's end, its first character."""
        at = self.places[index]
        return at - 1 if self.text[at - 1 : at + 1] == "\r\n" else at

    def entries(self) -> list[tuple[str, yaml.MappingNode]]:
        """(type, node) of every entry."""
        return [(str(_value_of(node, "type")), node) for node in self.root.value]

    def object_nodes(self) -> list[yaml.MappingNode]:
        """The objects' nodes, in the scene's order."""
        return [node for kind, node in self.entries() if kind in SHAPES]


def read_document(text: str, source: str = "<scene>") -> Document:
    """Reads a text with exactly one scene.

    Raises:
      InputError: it is no scene, or more than one.
    """
    plain = text.removeprefix("\ufeff")
    samples = parse_scenes(plain, source)
    if len(samples) + len(samples.problems) != 1:
        raise InputError(
            f"{source}: {len(samples) + len(samples.problems)} samples; expected one scene; keep one of them"
        )
    # What stands in the text, without the carriage returns that reading drops.
    kept = [k for k, c in enumerate(text) if not (c == "\r" and text[k + 1 : k + 2] == "\n")]
    normal = "".join(text[k] for k in kept)
    part = sample_texts(plain)[0]
    at = normal.rfind(part)
    if at < 0:
        raise InputError(f"{source}: thoughts stand inside the scene; expected them before it; remove them")
    root = yaml.compose(part, Loader=yaml.SafeLoader)
    if not isinstance(root, yaml.SequenceNode):
        raise InputError(f"{source}: expected a list of entries")
    places = (*kept, len(text))[at : at + len(part) + 1]
    return Document(text, source, samples[0], tuple(places), root, _shared(root))


def _shared(root: yaml.Node) -> frozenset[int]:
    """Ids of nodes that an alias makes stand in two places, and of all inside them."""
    seen: set[int] = set()
    twice: set[int] = set()

    def walk(node: yaml.Node, inside: bool) -> None:
        again = id(node) in seen
        if inside or again:
            if id(node) in twice:
                return
            twice.add(id(node))
        seen.add(id(node))
        for child in _children(node):
            walk(child, inside or again)

    walk(root, False)
    return frozenset(twice)


def _children(node: yaml.Node) -> Iterator[yaml.Node]:
    for child in node.value if isinstance(node, yaml.CollectionNode) else ():
        yield from child if isinstance(child, tuple) else (child,)


def find(node: yaml.Node, key: str | int) -> yaml.Node | None:
    """The value under a key or index, or None."""
    if isinstance(node, yaml.MappingNode):
        return next((value for name, value in node.value if name.value == key), None)
    if isinstance(node, yaml.SequenceNode) and isinstance(key, int) and key < len(node.value):
        return node.value[key]
    return None


def _value_of(node: yaml.Node, key: str) -> str | None:
    value = find(node, key)
    return value.value if isinstance(value, yaml.ScalarNode) else None


def is_null(node: yaml.Node | None) -> bool:
    """Whether there is no value."""
    return isinstance(node, yaml.ScalarNode) and node.tag == "tag:yaml.org,2002:null"


def content_end(node: yaml.Node) -> int:
    """Where the node's last character is followed by something else: a block's own mark lies behind the comments."""
    children = list(_children(node))
    if children and not getattr(node, "flow_style", False):
        return content_end(children[-1])
    return node.end_mark.index


def number_text(value: float, like: str = "") -> str:
    """A number with at most twelve digits and places, as YAML reads it; whole where ``like`` is written whole and it is."""
    if not math.isfinite(value):
        raise InputError(f"instruction: a number became {value:g}; expected a finite one; lower the amount")
    # What sines leave of a zero is a zero.
    short = 0.0 if abs(value) < 1e-12 else float(f"{value:.12g}")
    if _INTEGER.fullmatch(like) and short == int(short):
        return str(int(short))
    text = repr(short)
    # YAML 1.1 takes an exponent for a number's only behind a point.
    return text if "e" not in text or "." in text else text.replace("e", ".0e")


def vector_text(values: tuple[float, ...]) -> str:
    """A list in one line."""
    return f"[{', '.join(number_text(v) for v in values)}]"


def leaves(entry: dict, start: Path = ()) -> dict[Path, object]:
    """Every number, text or list of an entry, by its path; lists stay whole."""
    found: dict[Path, object] = {}
    for key, value in entry.items():
        found |= leaves(value, (*start, key)) if isinstance(value, dict) else {(*start, key): value}
    return found


def scene_leaves(scene: Scene) -> list[dict[Path, object]]:
    """The leaves of every entry as ``scene_entries`` has them."""
    return [leaves(entry) for entry in scene_entries(scene)]
