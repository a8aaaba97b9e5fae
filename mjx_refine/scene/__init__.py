"""Scenes: the YAML configuration, read, checked and written."""

from mjx_refine.scene.model import SHAPES, Body, Camera, Effect, Scene, Shape
from mjx_refine.scene.read import Problem, Samples, load_scene, load_scenes, parse_scenes, scene_from_entries
from mjx_refine.scene.write import dump_scene, save_scene, save_scenes, scene_entries

__all__ = [
    "SHAPES",
    "Body",
    "Camera",
    "Effect",
    "Problem",
    "Samples",
    "Scene",
    "Shape",
    "dump_scene",
    "load_scene",
    "load_scenes",
    "parse_scenes",
    "save_scene",
    "save_scenes",
    "scene_entries",
    "scene_from_entries",
]
