"""Turns a rough guess of a scene into a MuJoCo simulation that replays a video.

``refine(load_scenes("best32.yaml"), load_observation("flows.npz"), Options(seed=0)).scene`` is the refined scene.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mjx_refine.errors import InputError
    from mjx_refine.generate import GenerateOptions, Record, generate_scenes, read_records
    from mjx_refine.many import Job, Many, Outcome, load_jobs, refine_many
    from mjx_refine.observation import Observation, load_observation, make_observation, save_observation
    from mjx_refine.scene import Scene, load_scene, load_scenes, parse_scenes, save_scene, save_scenes
    from mjx_refine.search import Options, Progress, RefineResult, refine

__all__ = [
    "GenerateOptions",
    "InputError",
    "Job",
    "Many",
    "Observation",
    "Options",
    "Outcome",
    "Progress",
    "Record",
    "RefineResult",
    "Scene",
    "generate_scenes",
    "load_jobs",
    "load_observation",
    "load_scene",
    "load_scenes",
    "make_observation",
    "parse_scenes",
    "read_records",
    "refine",
    "refine_many",
    "save_observation",
    "save_scene",
    "save_scenes",
]

_MODULES = {
    "errors": ("InputError",),
    "generate": ("GenerateOptions", "Record", "generate_scenes", "read_records"),
    "many": ("Job", "Many", "Outcome", "load_jobs", "refine_many"),
    "observation": ("Observation", "load_observation", "make_observation", "save_observation"),
    "scene": ("Scene", "load_scene", "load_scenes", "parse_scenes", "save_scene", "save_scenes"),
    "search": ("Options", "Progress", "RefineResult", "refine"),
}
"""Where each name is from; imported when it is asked for, since a worker process needs little of all this."""


def __getattr__(name: str) -> object:
    for module, names in _MODULES.items():
        if name in names:
            globals()[name] = found = getattr(importlib.import_module(f"{__name__}.{module}"), name)
            return found
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
