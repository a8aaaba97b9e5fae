"""Scenes back to YAML; load -> write -> load gives the same scene."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import yaml

from mjx_refine import files
from mjx_refine.scene.model import Body, Scene


def _plain(value: Any) -> Any:
    """``value`` in Python's own numbers: numpy's are floats, but YAML does not know them."""
    if isinstance(value, dict):
        return {key: _plain(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return float(value) if isinstance(value, float) else value


def scene_entries(scene: Scene) -> list[dict]:
    """The list of entries that the YAML holds, of plain dicts, lists and numbers."""
    return _plain(_entries(scene))


def _entries(scene: Scene) -> list[dict]:
    entries = [_body_entry(body) for body in scene.objects]
    camera = scene.camera
    entries.append(
        {
            "type": "camera",
            "fovy": camera.fovy,
            "orientation": camera.orientation,
            "position": list(camera.position),
        }
    )
    entries.append({"type": "gravity", "gravity": list(scene.gravity)})
    for effect in scene.effects:
        entry: dict = {"type": "effect", "effect": effect.effect}
        if effect.target is not None:
            entry["target"] = effect.target
        entry["parameters"] = {k: list(v) if isinstance(v, tuple) else v for k, v in effect.parameters}
        entries.append(entry)
    return entries


def _body_entry(body: Body) -> dict:
    entry: dict = {"type": body.shape, "name": body.name}
    if body.shape == "box":
        entry["size"] = list(body.size)
    else:
        entry["radius"] = body.size[0]
        if body.shape == "cylinder":
            entry["height"] = body.size[1]
    entry["state"] = {
        "position": list(body.position),
        "orientation": list(body.orientation),
        "linear_velocity": list(body.linear_velocity),
        "angular_velocity": list(body.angular_velocity),
    }
    entry["physics"] = {
        "friction": list(body.friction),
        "mass": body.mass,
        "damping": body.damping,
        "stiffness": body.stiffness,
    }
    return entry


def _represent_list(dumper: yaml.SafeDumper, data: list) -> yaml.Node:
    """Lists of numbers in one line, mappings one key a line."""
    scalars = all(isinstance(v, int | float) for v in data)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=scalars)


class _Dumper(yaml.SafeDumper):
    """Writes what names people give."""


_Quick: type = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


class _QuickDumper(_Quick):
    """By libyaml, where PyYAML has it; it escapes some letters beyond ASCII."""


for _dumper in (_Dumper, _QuickDumper):
    _dumper.add_representer(list, _represent_list)


def dump_scene(scene: Scene) -> str:
    """The scene as YAML text; numbers keep every digit."""
    plain = all(name.isascii() and name.isprintable() for name in scene.names)
    dumper = _QuickDumper if plain and not scene.effects else _Dumper
    return yaml.dump(scene_entries(scene), Dumper=dumper, sort_keys=False, width=4096, allow_unicode=True)


def save_scene(path: str | os.PathLike, scene: Scene) -> Path:
    """Writes the scene as YAML, whole or not at all."""
    return files.write_text(path, dump_scene(scene))


def save_scenes(path: str | os.PathLike, scenes: list[Scene]) -> Path:
    """Writes several samples as YAML documents separated by ``---``."""
    return files.write_text(path, "---\n".join(dump_scene(scene) for scene in scenes))
