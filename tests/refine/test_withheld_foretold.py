"""Predictions with an exam's own numbers: they are right where its effects are the catalogue's."""

from __future__ import annotations

import dataclasses
import json

import pytest

pytest.importorskip("pybullet", reason="the exam needs the bench extra")

from effect_scenes import effect

from benchmarks.withheld.foretold import entries, foretold
from mjx_refine.observation import save_observation
from mjx_refine.scene import Body, Camera, Effect, Scene
from mjx_refine.scene.write import scene_entries
from mjx_refine.simulate import simulate

BALL = Body("sphere", "ball", (0.25,), (-0.6, 0.4, 0.8), linear_velocity=(2.0, 0.3, 1.5))
SCENE = Scene((BALL,), Camera((0.0, -2.0, 2.5), 50.0))


def folder_of(folder, number: str, told: Effect, true: Effect, hidden: dict | None = None) -> None:
    """A clip of ``true`` whose key tells of ``told``."""
    # Flow whose noise is stated is no measured one, which outlines draw along.
    seen = dataclasses.replace(simulate(dataclasses.replace(SCENE, effects=(true,)), (320, 214), 9), flow_sigma=0.05)
    (folder / "clips" / number).mkdir(parents=True)
    (folder / "key").mkdir(exist_ok=True)
    save_observation(folder / "clips" / number / "flows.npz", seen)
    row = {"effect": told.effect, "target": told.target, "parameters": dict(told.parameters), "hidden": hidden or {}}
    key = {"truth": scene_entries(SCENE), "effects": [row], "mask_ids": [1]}
    (folder / "key" / f"{number}.json").write_text(json.dumps(key))


def test_a_prediction_with_the_keys_numbers(tmp_path):
    lens, more = effect("lens_distortion", k1=0.12), effect("lens_distortion", k1=0.3)
    folder_of(tmp_path, "000", lens, lens)
    folder_of(tmp_path, "001", more, lens)
    # What no catalogue has is left out.
    folder_of(tmp_path, "002", Effect("vortex", "ball", (("strength", 1.0),)), lens)
    right, wrong = foretold(tmp_path)
    assert (right.clip, wrong.clip) == ("000", "001")
    assert right.effects == ("lens_distortion",)
    assert max(right.centroid, right.radius, right.flow) < 0.06
    assert wrong.centroid > 0.3


def test_a_wind_is_told_by_its_speed():
    wind = {
        "effect": "wind", "target": None, "parameters": {"x": 10.0, "y": 0.0, "unknown": 1.0}, "hidden": {"wind": [4.0, 3.0]}
    }  # fmt: skip
    told = entries({"truth": [], "effects": [wind]})
    assert told == [{"type": "effect", "effect": "wind", "parameters": {"x": 10.0, "y": 0.0, "slowness": 0.2}}]
