"""From a description's text back to what it says."""

from __future__ import annotations

import dataclasses
import re

from mjx_refine.describe.phrases import TEMPLATES
from mjx_refine.describe.statements import Statement
from mjx_refine.errors import InputError
from mjx_refine.scene import Scene, parse_scenes

# A full stop ends a sentence where a blank or the line's end follows; numbers and quoted names have none such.
_SENTENCE = re.compile(r'\s*((?:"(?:[^"\\]|\\.)*"|[^".]|\.(?!\s|$))+)\.(?=\s|$)')
_THINK = re.compile(r"<think>(.*?)</think>", re.DOTALL)


@dataclasses.dataclass(frozen=True)
class Parsed:
    """What a description says.

    Attributes:
      statements: in order.
      sentences: the sentence of each.
      problems: (sentence, reason) of what was not understood.
    """

    statements: tuple[Statement, ...]
    sentences: tuple[str, ...]
    problems: tuple[tuple[str, str], ...]


def parse_sentences(text: str) -> Parsed:
    """Reads the sentences of ``text``; ``it`` is the object that the sentence before, in the same line, was about."""
    statements: list[Statement] = []
    sentences: list[str] = []
    problems: list[tuple[str, str]] = []
    for line in text.splitlines():
        subject: str | None = None
        at = 0
        while line[at:].strip():
            match = _SENTENCE.match(line, at)
            if match is None:
                problems.append((line[at:].strip(), "no sentence that ends with a full stop"))
                break
            at, sentence = match.end(), match[1]
            try:
                statement = _parse_sentence(sentence, subject)
            except ValueError as error:
                problems.append((sentence, str(error)))
                continue
            statements.append(statement)
            sentences.append(sentence)
            subject = getattr(statement, "object", None)
    return Parsed(tuple(statements), tuple(sentences), tuple(problems))


def _parse_sentence(sentence: str, subject: str | None) -> Statement:
    found = {
        statement
        for templates in TEMPLATES.values()
        for template in templates
        if (statement := template.read(sentence, subject)) is not None
    }
    if len(found) != 1:
        raise ValueError("a sentence of no known form" if not found else "a sentence that can be read in two ways")
    return found.pop()


def parse_description(text: str, source: str = "<description>") -> tuple[Parsed, Scene]:
    """Reads ``<think>...</think><answer>...</answer>``: what the thoughts say, and the answer's scene.

    Raises:
      InputError: there are no thoughts, or the answer is no scene.
    """
    thoughts = _THINK.search(text)
    if thoughts is None:
        raise InputError(
            f"{source}: no <think>...</think> in it; expected a description; write one with `refine describe`"
        )
    samples = parse_scenes(text, source)
    if len(samples) + len(samples.problems) != 1:
        raise InputError(f"{source}: {len(samples) + len(samples.problems)} answers; expected one; keep one of them")
    return parse_sentences(thoughts[1]), samples[0]
