"""What the base model lacks: one kind of effect a file, and what they do to a batch."""

from mjx_refine.effects.acting import batch_with_effects, effect_entry
from mjx_refine.effects.kind import EffectKind, EffectParameter, Motion, OutlineView
from mjx_refine.effects.registry import acting_kind, catalogue, kind_of

__all__ = [
    "EffectKind",
    "EffectParameter",
    "Motion",
    "OutlineView",
    "acting_kind",
    "batch_with_effects",
    "catalogue",
    "effect_entry",
    "kind_of",
]
