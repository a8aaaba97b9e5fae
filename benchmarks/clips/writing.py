"""Samples as text, in the two ways a file of several may be written."""

from __future__ import annotations

from typing import Any

import numpy as np
import yaml

Entry = dict[str, Any]


def scene_text(entries: list[Entry]) -> str:
    """One scene as YAML; lists of numbers stay on one line."""
    return yaml.safe_dump(entries, sort_keys=False, default_flow_style=None, width=200)


def samples_text(scenes: list[list[Entry]], *, tagged: bool, broken: int = 0, seed: int = 0) -> str:
    """A file of samples.

    Args:
      scenes: the samples. tagged: as `<think>…</think><answer>…</answer>`; otherwise as documents parted by `---`.
      broken: how many samples are cut off in the middle, as when the model runs out of tokens. seed: which ones.
    """
    rng = np.random.default_rng([seed, 9])
    cut = set(rng.choice(len(scenes), broken, replace=False).tolist())
    texts = []
    for index, scene in enumerate(scenes):
        text = scene_text(scene)
        if index in cut:
            keep = int(len(text) * rng.uniform(0.3, 0.7))
            while text[keep - 1] != "[":  # inside a list, so that it cannot pass for a shorter scene
                keep -= 1
            text = text[:keep] + "0.1, "
        if tagged:
            text = f"<think>{_thought(scene)}</think>\n<answer>\n{text}\n</answer>\n"
        texts.append(text)
    return "\n".join(texts) if tagged else "---\n".join(text if text.endswith("\n") else text + "\n" for text in texts)


def _thought(scene: list[Entry]) -> str:
    names = [e["name"] for e in scene if "name" in e]
    quick = max((e for e in scene if "name" in e), key=lambda e: float(np.linalg.norm(e["state"]["linear_velocity"])))
    speed = float(np.linalg.norm(quick["state"]["linear_velocity"]))
    return f"The flow shows {len(names)} objects: {', '.join(names)}. {quick['name']} moves fastest, at about {speed:.1f} m/s."
