"""From what a language model wrote to the YAML texts of its samples."""

from __future__ import annotations

import re

_ANSWER = re.compile(r"<answer>(.*?)(?=</answer>|<answer>|\Z)", re.DOTALL)
_FENCE = re.compile(r"^[ \t]*```[^\n]*\n(.*?)(?:^[ \t]*```[^\n]*$|\Z)", re.DOTALL | re.MULTILINE)
_DOCUMENT = re.compile(r"^---(?:[ \t].*)?$", re.MULTILINE)


def sample_texts(text: str) -> list[str]:
    """Returns the YAML text of every sample in ``text``, in order.

    Reads plain YAML, YAML documents separated by ``---``, ``<answer>`` blocks (with or without ``<think>`` before
    them; the last may lack its end) and fenced code blocks. Texts are split before they are parsed, so that a broken
    sample leaves the others readable.
    """
    text = _without_thoughts(text.replace("\r\n", "\n"))
    answers = [match.group(1) for match in _ANSWER.finditer(text)]
    samples = []
    for part in answers or [text]:
        fenced = [match.group(1) for match in _FENCE.finditer(part)]
        for block in fenced or [part]:
            documents = [d for d in _DOCUMENT.split(block) if _has_content(d)]
            # An empty answer is a sample that failed, and must keep its index.
            samples.extend(documents or ([block] if answers else []))
    return samples


def _without_thoughts(text: str) -> str:
    """Cuts every ``<think>...</think>``, in one pass: a regular expression is quadratic where the ends are missing."""
    kept, at = [], 0
    while (start := text.find("<think>", at)) >= 0 and (end := text.find("</think>", start)) >= 0:
        kept.append(text[at:start])
        at = end + len("</think>")
    return "\n".join([*kept, text[at:]])


def _has_content(document: str) -> bool:
    lines = (line.strip() for line in document.splitlines())
    return any(line and not line.startswith(("#", "%", "...")) for line in lines)
