"""All kinds of effects: ours, and those that other packages register under the entry point ``mjx_refine.effects``."""

from __future__ import annotations

import functools
import importlib.metadata

from mjx_refine.effects.camera_motion import CameraMotion
from mjx_refine.effects.camera_roll import CameraRoll
from mjx_refine.effects.camera_shake import CameraShake
from mjx_refine.effects.drag import Drag
from mjx_refine.effects.dropped_frames import DroppedFrames
from mjx_refine.effects.free_force import FreeForce
from mjx_refine.effects.friction_patch import FrictionPatch
from mjx_refine.effects.hidden_obstacle import HiddenObstacle
from mjx_refine.effects.kind import EffectKind
from mjx_refine.effects.lens_distortion import LensDistortion
from mjx_refine.effects.magnus import Magnus
from mjx_refine.effects.mask_bias import MaskBias
from mjx_refine.effects.occluder import Occluder
from mjx_refine.effects.offset_com import OffsetCom
from mjx_refine.effects.push import Push
from mjx_refine.effects.rolling_shutter import RollingShutter
from mjx_refine.effects.shape import OutlineShape
from mjx_refine.effects.slope import Slope
from mjx_refine.effects.wind import Wind
from mjx_refine.errors import InputError

ENTRY_POINT = "mjx_refine.effects"

_OURS: tuple[type[EffectKind], ...] = (
    Drag,
    Magnus,
    Wind,
    Push,
    Slope,
    FrictionPatch,
    OffsetCom,
    HiddenObstacle,
    CameraMotion,
    CameraShake,
    CameraRoll,
    LensDistortion,
    RollingShutter,
    DroppedFrames,
    MaskBias,
    Occluder,
    OutlineShape,
)


@functools.cache
def catalogue() -> dict[str, EffectKind]:
    """Name to kind, ours first; a plugin that cannot be loaded is an error that names it.

    Raises:
      InputError: a plugin is no ``EffectKind``, does not load, or takes a name that is taken.
    """
    kinds = {kind.name: kind() for kind in _OURS}
    for entry in importlib.metadata.entry_points(group=ENTRY_POINT):
        place = f"entry point {ENTRY_POINT}: {entry.name} = {entry.value}"
        try:
            plugin = entry.load()
        except (ImportError, AttributeError) as error:
            raise InputError(f"{place}: does not load ({error}); correct or uninstall the plugin") from error
        if not (isinstance(plugin, type) and issubclass(plugin, EffectKind)):
            raise InputError(f"{place}: got {plugin!r}; expected a subclass of EffectKind; correct the plugin")
        if plugin.name in kinds or plugin.name in _UNNAMED:
            raise InputError(f"{place}: the name {plugin.name!r} is taken; rename the plugin's effect")
        kinds[plugin.name] = plugin()
    return kinds


def kind_of(name: str, place: str = "effect") -> EffectKind:
    """The kind called ``name``.

    Raises:
      InputError: there is none; ``place`` is named.
    """
    kinds = catalogue()
    if name not in kinds:
        raise InputError(f"{place} = {name!r}; expected one of {', '.join(kinds)}; correct the name")
    return kinds[name]


_UNNAMED: dict[str, EffectKind] = {FreeForce.name: FreeForce()}


def acting_kind(name: str) -> EffectKind:
    """The kind called ``name``, of the catalogue or of those that only a diagnosis compares with and no scene file holds."""
    return _UNNAMED[name] if name in _UNNAMED else kind_of(name)
