"""``edit``: a scene's text and an instruction to the text of the edited scene."""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Callable

from mjx_refine.batch import batch_from_scenes
from mjx_refine.edit import rules_scene  # noqa: F401  registers its rules
from mjx_refine.edit.amounts import NUMBER, VECTOR
from mjx_refine.edit.document import Document, Patch, read_document
from mjx_refine.edit.rewrite import rewritten, with_copy, without
from mjx_refine.edit.rules import FORMS, RULES, Step
from mjx_refine.edit.words import clauses, tokenised
from mjx_refine.errors import InputError
from mjx_refine.scene import Scene
from mjx_refine.scene.fields import cut
from mjx_refine.sim.c import MujocoSimulator

DEEPEST = 0.005
"""How much deeper than before objects may stand in one another or in the floor at the start [m]."""


class NotUnderstoodError(InputError):
    """No rule knows an instruction."""


@dataclasses.dataclass(frozen=True)
class Edit:
    """An edited scene.

    Attributes:
      before: the text as it was.
      after: the text as it is now.
      scene_before: what the old text says.
      scene: what the new text says.
    """

    before: str
    after: str
    scene_before: Scene
    scene: Scene

    def diff(self, before: str = "before", after: str = "after", context: int = 3) -> str:
        """The changed lines as a unified diff between files called ``before`` and ``after``; "" where nothing changed."""
        pair = [text.splitlines(keepends=True) for text in (self.before, self.after)]
        lines = difflib.unified_diff(*pair, fromfile=before, tofile=after, n=context)
        return "".join(line if line.endswith("\n") else f"{line}\n\\ No newline at end of file\n" for line in lines)


def edit(text: str, instruction: str, model: Callable[[str], str] | None = None, source: str = "<scene>") -> Edit:
    """Changes a scene as ``instruction`` says; what it does not speak of stays as it is, byte for byte.

    Args:
      text: of the scene file, which holds one scene.
      instruction: one or more instructions, joined by ``and``, commas, semicolons or line ends.
      model: a language model, any callable from a prompt to an answer, to do it instead of the rules; its answer is the
        whole new text, and must be a scene.
      source: the file's name in errors.

    Raises:
      InputError: the text is no scene, the instruction is not understood, or the edited scene is none that can be.
    """
    document = read_document(text, source)
    if not instruction.strip():
        raise InputError(f"instruction: empty; expected such as {FORMS[0]!r}; write one")
    if model is not None:
        return _by_model(document, instruction, model)
    after, last, verb = document, (), ""
    for clause in clauses(instruction, document.scene.names):
        try:
            step = understood(clause, after.scene, last)
            verb = clause.split()[0]
        except NotUnderstoodError:
            # "reduce its mass by 20% and its speed by 50%"
            if not verb or not re.match(r"(?:the|its|their)\b", clause, re.IGNORECASE):
                raise
            step = understood(f"{verb} {clause}", after.scene, last)
        after = _applied(after, step, clause)
        last = step.about or last
    _refuse_overlap(document.scene, after.scene)
    return Edit(text, after.text, document.scene, after.scene)


def understood(clause: str, scene: Scene, last: tuple[str, ...] = ()) -> Step:
    """What a single instruction does to ``scene``.

    Raises:
      NotUnderstoodError: no rule knows it; the message names the nearest forms that are known.
    """
    if len(clause) > 1000:
        raise InputError(f"instruction of {len(clause)} characters; expected at most 1000 each; split it")
    words = tokenised(clause, scene, last)
    for pattern, rule in RULES:
        match = pattern.fullmatch(words)
        step = None if match is None else rule(scene, match)
        if step is not None:
            return step
    near = "; ".join(f'"{form}"' for form in nearest_forms(words))
    # Where no object was recognised, what was meant may not be there.
    there = "" if "@" in words else f"; the scene's objects are {cut(', '.join(scene.names), 200)}"
    raise NotUnderstoodError(
        f"instruction {cut(clause, 80)!r} is not understood; expected such as {near}{there}; rephrase it"
    )


def nearest_forms(words: str, count: int = 3) -> list[str]:
    """The known forms that are most like a clause, the most like it first."""
    shape = re.sub(r"@[\d,]+", "OBJECT", re.sub(VECTOR, "[X, Y, Z]", words))
    shape = re.sub(rf"(?<![\w.@]){NUMBER}", "NUMBER", shape)
    plain = {re.sub(r"\b(?:the|a) ", "", form): form for form in FORMS}
    return [plain[one] for one in difflib.get_close_matches(shape, plain, count, 0.0)]


def _applied(document: Document, step: Step, clause: str) -> Document:
    """The document after a step, read again by the reader of all scenes."""
    source = document.source
    place = f"{source}, edited by {cut(clause, 60)!r}"
    text = rewritten(document, step.scene)
    wanted = list(step.scene.objects)
    for name in step.removed:
        text = without(_read(text, place, source), name)
        wanted = [body for body in wanted if body.name != name]
    if step.copied is not None:
        name, new, differ = step.copied
        if new in step.scene.names:
            raise InputError(f"instruction: there is an object {new!r} already; expected another name; rename the copy")
        copied = _read(with_copy(_read(text, place, source), name, new), place, source)
        at = step.scene.names.index(name)
        wanted.insert(at + 1, differ(dataclasses.replace(wanted[at], name=new)))
        text = rewritten(copied, dataclasses.replace(copied.scene, objects=tuple(wanted)))
    after = _read(text, place, source)
    _check(after.scene, dataclasses.replace(step.scene, objects=tuple(wanted)), place)
    return after


def _read(text: str, place: str, source: str) -> Document:
    return dataclasses.replace(read_document(text, place), source=source)


def _check(scene: Scene, wanted: Scene, place: str) -> None:
    """The text must say what the step meant, to the digits that are written."""
    for got, meant in zip((*scene.objects, scene.camera, scene), (*wanted.objects, wanted.camera, wanted), strict=True):
        for field in dataclasses.fields(got):
            pair = getattr(got, field.name), getattr(meant, field.name)
            if field.name not in ("objects", "camera") and not _alike(*pair):
                raise InputError(
                    f"{place}: {field.name} became {pair[0]} instead of {pair[1]}; expected keys and names in every "
                    "entry; write them out"
                )


def _alike(got: object, meant: object) -> bool:
    if isinstance(got, tuple) and isinstance(meant, tuple):
        return len(got) == len(meant) and all(map(_alike, got, meant))
    if isinstance(got, float) and isinstance(meant, float):
        return abs(got - meant) <= 1e-9 * max(1.0, abs(meant))
    return got == meant


def depths(scene: Scene) -> dict[frozenset[str], float]:
    """How deep objects stand in one another, or in "the floor", at the start [m]."""
    batch = batch_from_scenes([scene])
    names = ("the floor", *scene.names)
    found: dict[frozenset[str], float] = {}
    for first, second, distance, _ in MujocoSimulator(scene.shapes, 30.0, threads=1).contacts(batch, 0):
        pair = frozenset((names[first + 1], names[second + 1]))
        found[pair] = max(found.get(pair, 0.0), -distance)
    return found


def _refuse_overlap(before: Scene, after: Scene) -> None:
    old = depths(before)
    for pair, depth in depths(after).items():
        if depth - old.get(pair, 0.0) > DEEPEST:
            names = sorted(pair, key=lambda name: name == "the floor")
            raise InputError(
                f"instruction: {names[0]} would stand {depth:.3f} m deep in {names[1]} at the start; expected objects apart; "
                "move one of them"
            )


def prompt(text: str, instruction: str) -> str:
    """What a language model is asked."""
    return (
        "Edit this MuJoCo scene as the instruction says. Answer with the whole edited YAML inside <answer></answer>; change "
        f"nothing else.\n\nInstruction: {instruction.strip()}\n\n{text}"
    )


def _by_model(document: Document, instruction: str, model: Callable[[str], str]) -> Edit:
    answer = model(prompt(document.yaml, instruction))
    if not isinstance(answer, str):
        raise InputError(
            f"the model's answer is a {type(answer).__name__}; expected the text of a scene; correct the model"
        )
    after = read_document(answer, "the model's answer")
    _refuse_overlap(document.scene, after.scene)
    old, new = document.yaml, after.yaml.strip("\n")
    lead, trail = len(old) - len(old.lstrip("\n")), len(old) - len(old.rstrip("\n"))
    text = document.patched([Patch(lead, len(old) - trail, new)])
    return Edit(document.text, text, document.scene, read_document(text, "the model's answer").scene)
