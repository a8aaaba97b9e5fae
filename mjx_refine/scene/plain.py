"""YAML of plain data: safe, without the same key twice, without aliases that grow beyond measure."""

from __future__ import annotations

import os
from pathlib import Path

import yaml

from mjx_refine.errors import InputError
from mjx_refine.scene import fields

MAX_BYTES = 32 * 2**20
MAX_NODES = 100_000

WORDS = ("name", "init", "video")
"""Keys whose values are words as they are written: YAML would read the name ``000_1`` as 1 and ``no`` as false."""

_NO_WORDS = tuple(f"tag:yaml.org,2002:{kind}" for kind in ("int", "float", "bool", "timestamp"))


def read_text(path: str | os.PathLike, what: str) -> str:
    """The UTF-8 text of a file of at most ``MAX_BYTES``; ``what`` was expected, for errors.

    Raises:
      InputError: it cannot be read.
    """
    path = Path(path)
    try:
        with open(path, "rb") as stream:
            content = stream.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be read ({reason}); expected {what}; check the name") from error
    if len(content) > MAX_BYTES:
        raise InputError(f"{path}: larger than {MAX_BYTES >> 20} MiB; expected {what}; split the file")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: byte {error.start} is not UTF-8; expected {what} as text") from error


def load_plain(text: str, place: str, what: str) -> object:
    """The one document in ``text``, of plain data; ``place`` and ``what`` name it in errors.

    Raises:
      InputError: broken or unsafe YAML, or aliases make it refer to itself or grow beyond ``MAX_NODES``.
    """
    try:
        return _load_yaml(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f": line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = getattr(error, "problem", None) or str(error)
        raise InputError(f"{place}{line}: not safe YAML: {fields.cut(problem)}; correct or remove {what}") from error
    except (
        ValueError,
        RecursionError,
        ArithmeticError,
        TypeError,
        AttributeError,
        KeyError,
        IndexError,
    ) as error:
        raise InputError(f"{place}: not readable YAML: {fields.cut(str(error))}; correct or remove {what}") from error


class _UniqueKeyLoader(yaml.SafeLoader):
    """A safe loader that refuses a mapping with the same key twice."""


def _construct_mapping(loader: _UniqueKeyLoader, node: yaml.MappingNode) -> dict:
    seen = set()
    for key_node, value_node in node.value:
        key = key_node.value if isinstance(key_node, yaml.ScalarNode) else None
        if key in seen:
            raise yaml.constructor.ConstructorError(
                None, None, f"the key {fields.show(key)} stands twice", key_node.start_mark
            )
        seen.add(key)
        if key in WORDS and isinstance(value_node, yaml.ScalarNode) and value_node.tag in _NO_WORDS:
            value_node.tag = yaml.resolver.BaseResolver.DEFAULT_SCALAR_TAG
    return yaml.SafeLoader.construct_mapping(loader, node, deep=True)


_UniqueKeyLoader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _construct_mapping)


def _load_yaml(text: str) -> object:
    """The one document in ``text``, of plain data.

    Raises:
      yaml.YAMLError: broken, unsafe, or aliases make it refer to itself or grow beyond MAX_NODES.
    """
    loader = _UniqueKeyLoader(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        _expanded_size(node, {})
        return loader.construct_document(node)
    finally:
        loader.dispose()


def _expanded_size(node: yaml.Node, known: dict[int, int | None]) -> int:
    """How many nodes ``node`` holds where every alias counts in full."""
    if id(node) in known:
        size = known[id(node)]
        if size is None:
            raise yaml.constructor.ConstructorError(None, None, "an alias refers to itself", node.start_mark)
        return size
    known[id(node)] = None
    children = node.value if isinstance(node, yaml.CollectionNode) else ()
    if isinstance(node, yaml.MappingNode):
        children = [part for pair in children for part in pair]
    size = 1 + sum(_expanded_size(child, known) for child in children)
    if size > MAX_NODES:
        raise yaml.constructor.ConstructorError(
            None, None, f"more than {MAX_NODES} values, with aliases written out", node.start_mark
        )
    known[id(node)] = size
    return size
