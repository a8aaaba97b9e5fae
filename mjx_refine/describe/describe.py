"""A scene's motion in words, and the scene itself, in the form that a vision-language model answers in."""

from __future__ import annotations

import dataclasses

import numpy as np

from mjx_refine.describe.phrases import TEMPLATES
from mjx_refine.describe.record import Record, record
from mjx_refine.describe.statements import Statement
from mjx_refine.describe.tell import tell
from mjx_refine.errors import InputError
from mjx_refine.scene import Scene, dump_scene, parse_scenes

_PRONOUNS = 0.75
"""How often an object that was just spoken of is called ``it``."""


@dataclasses.dataclass(frozen=True)
class Description:
    """A description.

    Attributes:
      text: ``<think>...</think>`` and ``<answer>...</answer>``, which holds the scene's YAML.
      statements: what the thoughts say, in order.
      record: the simulation that they were taken from.
    """

    text: str
    statements: tuple[Statement, ...]
    record: Record


def describe(
    scene: Scene, frames: int = 30, fps: float = 30.0, size: tuple[int, int] = (480, 320), seed: int = 0
) -> Description:
    """Simulates ``scene`` in C MuJoCo and tells by rules what happens.

    Args:
      scene: its effects may change how it is seen, not how it moves.
      frames: number of frames, at least 2.
      fps: frames a second.
      size: (width, height) of the pictures in which objects are seen or not [px].
      seed: which of the paraphrases.

    Raises:
      InputError: the scene cannot be simulated or described.
    """
    seen = record(scene, frames, fps, size)
    paragraphs = tell(seen)
    rng = np.random.default_rng(seed)
    lines = [written(paragraph, rng) for paragraph in paragraphs]
    text = "<think>\n" + "\n".join(lines) + "\n</think>\n<answer>\n" + dump_scene(scene) + "</answer>\n"
    again = _read_back(text)
    if again != scene:
        raise InputError(
            "a name or text in the scene ends the answer, so that it cannot be read back; expected names without "
            "</answer> and ---; rename it"
        )
    return Description(text, tuple(told for paragraph in paragraphs for told in paragraph), seen)


def _read_back(text: str) -> Scene | None:
    try:
        samples = parse_scenes(text)
    except InputError:
        return None
    return samples[0] if len(samples) == 1 and not samples.problems else None


def written(paragraph: list[Statement], rng: np.random.Generator) -> str:
    """The statements as one line of sentences, each in one of its paraphrases."""
    sentences, subject = [], None
    for statement in paragraph:
        templates = TEMPLATES[type(statement)]
        name = getattr(statement, "object", None)
        pronoun = name is not None and name == subject and rng.random() < _PRONOUNS
        sentences.append(templates[rng.integers(len(templates))].write(statement, rng, pronoun) + ".")
        subject = name
    return " ".join(sentences)
