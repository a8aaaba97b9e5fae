"""The exam's results, as Markdown."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.withheld import left
from benchmarks.withheld.answer import answered
from benchmarks.withheld.marks import APART, LOCATED, Mark, mark
from benchmarks.withheld.plan import SPLITS

LEFT = ((0, 1), (1, 3), (3, 6), (6, 12), (12, 40))
LEAST_LEFT = 3.0  # px: of an effect of which less is left, a clip hardly tells
SIZES = ((3, 6), (6, 12), (12, 24), (24, 40))
BINS = 10


def marks(exam: Path, answers: Path) -> list[Mark]:
    """Every clip's mark.

    Raises:
      ValueError: some clip has no standing answer (the message names them), or an answer breaks the format.
    """
    keys = sorted(path for path in (exam / "key").glob("*.json") if path.stem.isdigit())
    missing = [path.stem for path in keys if not answered(answers / path.stem)]
    if missing or not keys:
        raise ValueError(f"{len(missing)} of {len(keys)} clips have no answer yet: {', '.join(missing)}")
    out, lefts = [], left.read(exam)
    for path in keys:
        folder = answers / path.stem
        key, diagnosis, ran = (
            json.loads(file.read_text()) for file in (path, folder / "diagnosis.json", folder / "answer.json")
        )
        try:
            out.append(mark(path.stem, key, diagnosis, ran, lefts.get(path.stem)))
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{folder / 'diagnosis.json'}: {type(error).__name__} {error}") from error
    return out


def calibration_error(probabilities: list[float], right: list[bool], bins: int = BINS) -> float:
    """Expected calibration error: |share right - mean probability| over equal bins, weighted by what is in them.

    Naeini, Cooper & Hauskrecht, AAAI 2015, section "Calibration measures".
    """
    held: dict[int, list[tuple[float, bool]]] = defaultdict(list)
    for p, ok in zip(probabilities, right, strict=True):
        held[min(int(p * bins), bins - 1)].append((p, ok))
    total = sum(abs(sum(ok for _, ok in v) - sum(p for p, _ in v)) for v in held.values())
    return total / len(probabilities)


def report(found: list[Mark]) -> str:
    """All tables."""
    parts = [_summary(found), _calibration(found), _places(found), _effects(found), _sizes(found), _flows(found)]
    if any(m.lefts for m in found):
        parts += [_left(found), _left_sizes(found)]
    parts += [_parameters(found), _confusion(found), _missed(found), _list(found)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _share(values: Iterable[bool]) -> str:
    listed = list(values)
    return f"{sum(listed)}/{len(listed)} ({100 * sum(listed) / len(listed):.0f} %)" if listed else "-"


def _median(values: Iterable[float | None], form: str = "{:.2f}") -> str:
    listed = [v for v in values if v is not None]
    return form.format(median(listed)) if listed else "-"


def _table(head: list[str], rows: Iterable[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _of(found: list[Mark], split: str) -> list[Mark]:
    return [m for m in found if m.split == split]


def _summary(found: list[Mark]) -> str:
    one, two, none = _of(found, "one"), _of(found, "two"), _of(found, "none")
    rows = [
        ["one effect: right name first", _share(m.first for m in one)],
        ["one effect: exactly that verdict", _share(m.right for m in one)],
        ["one effect: among the first two, or declared indistinguishable", _share(m.near for m in one)],
        ["two effects: both names, no other", _share(m.right for m in two)],
        ["two effects: both names among those said", _share(set(m.truth) <= set(m.said) for m in two)],
        ["two effects: one of them first", _share(m.first for m in two)],
        ["no effect: false alarms", _share(bool(m.said) for m in none)],
        ["withheld effect: unknown", _share(m.right for m in _of(found, "withheld"))],
        [
            "strange effect: unknown, or another name that the key accepts",
            _share(m.right for m in _of(found, "strange")),
        ],
        ["gap closed where the verdict is right, median", _median(m.closed for m in [*one, *two] if m.right)],
        ["gap closed where the right name is first, median", _median(m.closed for m in one if m.first)],
        ["seconds a clip, median (worst)", f"{_median((m.seconds for m in found), '{:.0f}')} ({_worst(found):.0f})"],
        ["peak memory, MB, largest", f"{max(m.peak_mb for m in found):.0f}"],
    ]
    return _table([f"{len(found)} clips", "result"], rows)


def _worst(found: list[Mark]) -> float:
    return max(m.seconds for m in found)


def _calibration(found: list[Mark]) -> str:
    error = calibration_error([m.probability for m in found], [m.right for m in found])
    rows = []
    for low in range(BINS):
        held = [m for m in found if min(int(m.probability * BINS), BINS - 1) == low]
        if held:
            mean = sum(m.probability for m in held) / len(held)
            rows.append([f"{low / BINS:.1f}-{(low + 1) / BINS:.1f}", f"{mean:.2f}", _share(m.right for m in held)])
    return f"Expected calibration error {error:.3f}.\n\n" + _table(["probability", "mean", "right"], rows)


def _places(found: list[Mark]) -> str:
    rows = []
    for name in LOCATED:
        held = [m for m in _of(found, "one") if m.truth == (name,)]
        columns: list[Callable[[Mark], bool | None]] = [
            lambda m: m.object_right,
            lambda m: m.frames_right,
            lambda m: m.since_right,
            lambda m: bool(m.object_right and m.frames_right),
        ]
        rows.append([name, *(_share(bool(column(m)) for m in held) for column in columns)])
    head = ["where", "object", "frames: where it acts ±2", "frames: from there on", "object and frames where it acts"]
    return _table(head, rows)


def _effects(found: list[Mark]) -> str:
    one = _of(found, "one")
    rows = []
    for name in sorted({m.truth[0] for m in one}):
        held = [m for m in one if m.truth[0] == name]
        closed = _median(m.closed for m in held if m.first)
        rows.append([name, _share(m.first for m in held), _share(m.near for m in held), closed])
    return _table(["effect", "first", "first two", "closed"], rows)


def _sizes(found: list[Mark]) -> str:
    rows = []
    for low, high in SIZES:
        held = [m for m in _of(found, "one") if m.px is not None and _within(m.px, low, high)]
        rows.append([f"{low}-{high} px", _share(m.first for m in held), _share(m.near for m in held)])
    return _table(["size", "first", "first two"], rows)


def _within(px: float, low: int, high: int) -> bool:
    """Sizes are aimed at 3 to 40 and miss by a little: the outermost classes are open."""
    return (px >= low or low == SIZES[0][0]) and (px < high or high == SIZES[-1][1])


def _left(found: list[Mark]) -> str:
    held = [m for m in found if m.px_left is not None and m.px_left >= LEAST_LEFT]
    one, two = _of(held, "one"), _of(held, "two")
    rows = [
        [f"one effect, of those with >= {LEAST_LEFT:g} px left: first", _share(m.first for m in one)],
        [f"one effect, of those with >= {LEAST_LEFT:g} px left: first two", _share(m.near for m in one)],
        [f"two effects, both with >= {LEAST_LEFT:g} px left: both names, no other", _share(m.right for m in two)],
        [f"two effects, both with >= {LEAST_LEFT:g} px left: one of them first", _share(m.first for m in two)],
        [f"withheld effect with >= {LEAST_LEFT:g} px left: unknown", _share(m.right for m in _of(held, "withheld"))],
        [
            f"strange effect with >= {LEAST_LEFT:g} px left: unknown, or a name that the key accepts",
            _share(m.right for m in _of(held, "strange")),
        ],
    ]
    with_effects = [m for m in found if m.truth]
    told = sum(bool(m.lefts) for m in with_effects)
    return _table(
        [f"what the base model's refit leaves ({told} of {len(with_effects)} clips measured)", "result"], rows
    )


def _left_sizes(found: list[Mark]) -> str:
    rows = []
    for low, high in LEFT:
        top = float("inf") if high == LEFT[-1][1] else high
        held = [m for m in _of(found, "one") if m.px_left is not None and low <= m.px_left < top]
        title = f"{low}-{high}{'+' if top > high else ''} px"
        rows.append([title, _share(m.first for m in held), _share(m.near for m in held)])
    return _table(["size left by a refit", "first", "first two"], rows)


def _missed(found: list[Mark]) -> str:
    """One-effect clips whose effect is not named first, the most that is left first; nothing where there is none."""
    missed = [m for m in _of(found, "one") if not m.first]
    rows = []
    for m in sorted(missed, key=lambda m: (-(m.px_left or 0), -(m.px or 0))):
        sizes = ["" if v is None else f"{v:.1f}" for v in (m.px, m.px_left)]
        rows.append([m.clip, m.truth[0], *sizes, _said(m), str(m.rank or "-")])
    head = ["missed clip", "effect", "px", "px left", "answer", "rank of the right name"]
    return _table(head, rows) if rows else ""


def _flows(found: list[Mark]) -> str:
    rows = []
    for flow in ("exact", "dis"):
        held = [m for m in found if m.flow == flow]
        one = _of(held, "one")
        alarms = _share(bool(m.said) for m in _of(held, "none"))
        rows.append([flow, _share(m.first for m in one), alarms, _share(m.right for m in held)])
    return _table(["flow", "one effect: first", "none: false alarms", "all: right"], rows)


def _parameters(found: list[Mark]) -> str:
    held: dict[str, list[float]] = defaultdict(list)
    for m in found:
        for name, error in m.errors.items():
            held[name].append(error)
    own = {f"{effect}: {title}" for effect, titles in APART.items() for title in titles} | {
        "hidden_obstacle: angle [deg]"
    }
    rows = [
        [name, str(len(errors)), f"{median(errors):.3g}" if name in own else f"{100 * median(errors):.0f} %"]
        for name, errors in sorted(held.items())
    ]
    return _table(["parameter", "clips", "median error"], rows)


def _confusion(found: list[Mark]) -> str:
    """Truth down, verdict across."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for m in found:
        truth = "+".join(m.truth) or "none"
        counts[truth if m.split in ("one", "two", "none") else f"{truth} ({m.split})"][_said(m)] += 1
    columns = sorted({said for row in counts.values() for said in row})
    rows = [[truth, *(str(row[c]) if row[c] else "" for c in columns)] for truth, row in sorted(counts.items())]
    return _table(["truth \\ verdict", *columns], rows)


def _said(m: Mark) -> str:
    return "+".join(sorted(m.said)) or "none"


def _list(found: list[Mark]) -> str:
    rows = []
    for m in sorted(found, key=lambda m: (SPLITS.index(m.split), m.truth, m.clip)):
        px = "" if m.px is None else f"{m.px:.1f}"
        cells: list[Any] = [m.clip, m.split, m.kind, m.flow, "+".join(m.truth) or "none", px, _said(m)]
        rows.append([*map(str, cells), f"{m.probability:.2f}", "yes" if m.right else "no", f"{m.seconds:.0f}"])
    return _table(["clip", "split", "motion", "flow", "truth", "px", "verdict", "p", "right", "s"], rows)
