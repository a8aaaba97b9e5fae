"""From an instruction's text to clauses in which objects are tokens: ``@0`` the first, ``@0,2`` the first and third."""

from __future__ import annotations

import json
import re

from mjx_refine.errors import InputError
from mjx_refine.scene import Scene

_QUOTED = re.compile(r'"(?:[^"\\]|\\.)*"')
# Of a list of vectors' numbers no comma is a joint, and of a number no point is a full stop.
_JOINTS = re.compile(r"\s*(?:;|\n|\.(?=\s|$)|,?\s+and\s+then\s+|,?\s+then\s+|,?\s+and\s+|,\s+)\s*", re.IGNORECASE)
_SHAPES = {"box": "box", "cube": "box", "block": "box", "sphere": "sphere", "ball": "sphere", "cylinder": "cylinder"}
_PLURALS = {
    "boxes": "box",
    "cubes": "box",
    "blocks": "box",
    "spheres": "sphere",
    "balls": "sphere",
    "cylinders": "cylinder",
}
_EVERYTHING = ("everything", "all objects", "every object", "each object", "all of them", "objects")
_FILLING = re.compile(r"\b(?:the|an?|please|now|also)\b\s*", re.IGNORECASE)
TARGET = r"(?P<who>@\d+(?:,\d+)*)"

# Words of the instructions themselves are no names unless they stand in quotation marks.
_RESERVED = {
    *_SHAPES, *_PLURALS, "all", "and", "as", "at", "by", "camera", "copy", "down", "everything", "gravity", "height", "it",
    "its", "left", "mass", "move", "of", "remove", "right", "set", "size", "spin", "stop", "the", "to", "up", "x", "y", "z",
}  # fmt: skip


def clauses(instruction: str, names: tuple[str, ...]) -> list[str]:
    """The single instructions of a text, joined in it by ``and``, commas, semicolons, full stops or line ends.

    ``names`` are the objects': a part that begins with one is another object of the instruction before it.
    """
    quoted: list[str] = []

    def keep(match: re.Match[str]) -> str:
        quoted.append(match[0])
        return f"\x00{len(quoted) - 1}\x00"

    text = re.sub(r"[\[(][^\])]*[\])]", keep, _QUOTED.sub(keep, instruction.replace("\x00", " ").strip()))
    parts, joints, at = [], [""], 0
    for match in _JOINTS.finditer(text):
        parts.append(text[at : match.start()])
        joints.append(match[0])
        at = match.end()
    parts.append(text[at:])
    found: list[str] = []
    for joint, part in zip(joints, parts, strict=True):
        if not part.strip():
            continue
        if found and _continues(part, joint, names):
            found[-1] += f" and {part}"
        else:
            found.append(part)
    return [_restored(part, quoted).strip() for part in found]


def _restored(text: str, quoted: list[str]) -> str:
    # What was kept first may stand inside what was kept later.
    while "\x00" in text:
        text = re.sub(r"\x00(\d+)\x00", lambda match: quoted[int(match[1])], text)
    return text


def _continues(part: str, joint: str, names: tuple[str, ...]) -> bool:
    """Whether a part is no instruction but one more object of the one before: it begins with a name."""
    if ";" in joint or "\n" in joint or "." in joint or "then" in joint:
        return False
    first = re.match(r"\s*(?:the\s+)?(\S+)", part, re.IGNORECASE)
    return first is not None and (first[1].startswith("\x00") or first[1] in names or first[1].lower() in _SHAPES)


def tokenised(clause: str, scene: Scene, last: tuple[str, ...]) -> str:
    """A clause with tokens for objects, ``its`` and possessives as ``of @n``, in single blanks, without articles.

    Args:
      clause: one instruction.
      scene: whose objects it may name.
      last: names of the objects that the clause before was about, for ``it``.

    Raises:
      InputError: ``the box`` where there are several or none, ``it`` where nothing was named.
    """
    names = {name: index for index, name in enumerate(scene.names)}

    def token(indices: list[int]) -> str:
        return f" @{','.join(map(str, indices))} "

    def named(match: re.Match[str]) -> str:
        text = match[0]
        if text.startswith('"'):
            try:
                text = json.loads(text)
            except ValueError:
                return match[0]
        return token([names[text]]) if text in names else match[0].replace("@", "?")

    plain = sorted((re.escape(n) for n in names if n.lower() not in _RESERVED), key=len, reverse=True)
    ends = [rf"(?<![\w.-])(?:{'|'.join(plain)})(?![\w-])"] if plain else []
    text = re.sub("|".join([_QUOTED.pattern, *ends, "@"]), named, clause)
    text = _described(text, scene, token)
    text = _pronouns(text, [names[name] for name in last if name in names], token)
    text = re.sub(r"\s+", " ", _FILLING.sub("", text)).strip().rstrip(".!").strip()
    while (joined := re.sub(r"@([\d,]+) ?(?:, ?and|,|and) @([\d,]+)", r"@\1,\2", text)) != text:
        text = joined
    text = re.sub(r"(@[\d,]+) ?'s? ([\w-]+(?: [\w-]+)*?)(?= (?:by|to|along|about|in)\b|$)", r"\2 of \1", text)
    return re.sub(r"(of @[\d,]+) ((?:along|about|in) [xyz](?:[- ](?:axis|direction))?)(?![\w-])", r"\2 \1", text)


def _described(text: str, scene: Scene, token) -> str:
    """With tokens for ``the box``, ``every ball``, ``all objects``."""

    def one(match: re.Match[str]) -> str:
        shape = _SHAPES[match[1].lower()]
        found = [k for k, body in enumerate(scene.objects) if body.shape == shape]
        if len(found) != 1:
            raise InputError(
                f"instruction: {match[0]!r} may be {', '.join(scene.names[k] for k in found) or 'nothing'}; expected one "
                "object; name it"
            )
        return token(found)

    def many(match: re.Match[str]) -> str:
        shape = {**_SHAPES, **_PLURALS}[match[1].lower()]
        found = [k for k, body in enumerate(scene.objects) if body.shape == shape]
        if not found:
            raise InputError(
                f"instruction: {match[0]!r}: there is none; expected one of {', '.join(scene.names)}; name it"
            )
        return token(found)

    flags = re.IGNORECASE
    text = re.sub(
        rf"(?<![\w-])(?:{'|'.join(_EVERYTHING)})(?![\w-])", token(list(range(len(scene.objects)))), text, flags=flags
    )
    every = rf"(?<![\w-])(?:(?:every|each|all)(?: the)? ({'|'.join([*_SHAPES, *_PLURALS])}))(?![\w-])"
    text = re.sub(every, many, text, flags=flags)
    text = re.sub(rf"(?<![\w-])(?:the )?({'|'.join(_PLURALS)})(?![\w-])", many, text, flags=flags)
    return re.sub(rf"(?<![\w-])(?:the )?({'|'.join(_SHAPES)})(?![\w-])", one, text, flags=flags)


def _pronouns(text: str, last: list[int], token) -> str:
    pattern = re.compile(r"(?<![\w-])(its|their|it|them)(?![\w-])", re.IGNORECASE)
    word = pattern.search(text)
    if word is None:
        return text
    if not last:
        raise InputError(f"instruction: {word[0]!r} of nothing named before; expected an object; name it")
    return pattern.sub(lambda m: token(last) + ("'s " if m[1].lower() in ("its", "their") else ""), text)
