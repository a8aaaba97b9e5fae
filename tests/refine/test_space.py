"""The parameter space: exact at its start, physical everywhere, without redundant directions, for any scene."""

from __future__ import annotations

import dataclasses
import math

import mujoco
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from mjx_refine.batch import ARRAYS, SceneBatch, batch_from_scenes
from mjx_refine.scene import SHAPES, Body, Camera, Scene
from mjx_refine.scene.read import scene_from_entries
from mjx_refine.scene.write import scene_entries
from mjx_refine.space import Parameter, Space

CAMERA = Camera((0.1, -3.0, 2.0), 60.0, 45.0)


def turned(*quaternion: float) -> tuple[float, float, float, float]:
    unit = np.array(quaternion, float) / np.linalg.norm(quaternion)
    return tuple(unit.tolist())


def body(shape: str, orientation=(1.0, 0.0, 0.0, 0.0), clearance: float = 0.0, **changes) -> Body:
    size = {"sphere": (0.2,), "box": (0.3, 0.2, 0.1), "cylinder": (0.2, 0.7)}[shape]
    quick = {
        "linear_velocity": (1.0, -0.5, 0.3),
        "angular_velocity": (1.0, 2.0, -3.0),
        "damping": -7.0,
        "friction": (0.4, 0.02),
    }
    made = Body(shape, f"{shape}_0", size, (0.3, -0.2, 0.0), orientation, **{**quick, **changes})
    return dataclasses.replace(made, position=(0.3, -0.2, clearance - lowest(Scene((made,), CAMERA))[0]))


def lowest(scene: Scene | SceneBatch, row: int = 0) -> np.ndarray:
    """Height of each object's lowest point [m], by MuJoCo's quaternions and plain geometry."""
    batch = batch_from_scenes([scene]) if isinstance(scene, Scene) else scene
    result = []
    for i, shape in enumerate(batch.shapes):
        x, y, z = batch.size[row, i]
        if shape == "box":
            corners = [(a, b, c) for a in (-x, x) for b in (-y, y) for c in (-z, z)]
            reach = min(rotated(batch.quaternion[row, i], c)[2] for c in corners)
        elif shape == "sphere":
            reach = -x
        else:
            # The lower end's disc: its centre, and from there down along its plane.
            axis = rotated(batch.quaternion[row, i], (0.0, 0.0, 1.0))
            reach = -abs(axis[2]) * y - x * math.hypot(axis[0], axis[1])
        result.append(batch.position[row, i, 2] + reach)
    return np.array(result)


def rotated(quaternion, vector) -> np.ndarray:
    result = np.zeros(3)
    mujoco.mju_rotVecQuat(result, np.array(vector, float), np.array(quaternion, float))
    return result


LYING = turned(1, 1, 0, 0)
STARTS = {
    "sphere": body("sphere"),
    "sphere in the air": body("sphere", turned(0.3, 0.2, -0.5, 0.1), 0.7),
    "flat box": body("box"),
    "tilted box": body("box", turned(0.8, 0.3, -0.2, 0.4), 0.2),
    "box on its head": body("box", turned(0.01, 1, 0.02, 0)),
    "upright cylinder": body("cylinder"),
    "cylinder on its head": body("cylinder", turned(0, 0.9, 0.1, 0)),
    "slanting cylinder": body("cylinder", turned(math.cos(0.39), math.sin(0.39), 0, 0), 0.1),
    "lying cylinder": body("cylinder", LYING),
    "lying cylinder that is turned": body("cylinder", turned(0.7, 0.6, 0.2, 0.3), 0.05),
    "steep cylinder": body("cylinder", turned(math.cos(0.4), math.sin(0.4), 0, 0), 0.3),
}


def numbers(scene: Scene) -> np.ndarray:
    batch = batch_from_scenes([scene])
    fields = list(ARRAYS)
    return np.concatenate([getattr(batch, name).reshape(-1) for name in fields])


@pytest.mark.parametrize("start", STARTS.values(), ids=STARTS)
def test_the_start_decodes_to_the_scene(start):
    scene = Scene((start, dataclasses.replace(body("box", clearance=1.0), name="other")), CAMERA, (0.3, 0.0, -7.0))
    space = Space.around(scene)
    np.testing.assert_allclose(numbers(space.scene_at(space.start)), numbers(scene), rtol=1e-12, atol=1e-12)
    assert space.scene_at(space.start).names == scene.names


def test_an_object_in_the_floor_is_lifted_onto_it():
    scene = Scene((body("box", turned(0.8, 0.3, -0.2, 0.4), -0.15),), CAMERA)
    space = Space.around(scene)
    assert lowest(space.scene_at(space.start))[0] == pytest.approx(0.0, abs=1e-12)


# Any scene that can be read ---------------------------------------------------------------------------------------------


def near(low: float, high: float, *special: float) -> st.SearchStrategy[float]:
    return st.one_of(st.floats(low, high), st.sampled_from([low, high, *special]))


def vectors(count: int, low: float, high: float, *special: float):
    return st.lists(near(low, high, *special), min_size=count, max_size=count)


@st.composite
def entries(draw) -> list[dict]:
    """What a file may hold: every number anywhere in the range that the reader accepts."""
    result: list[dict] = []
    for i in range(draw(st.integers(1, 3))):
        shape = draw(st.sampled_from(SHAPES))
        lengths = {"sphere": ("radius",), "cylinder": ("radius", "height"), "box": ()}[shape]
        size = {name: draw(near(1e-4, 1e3, 0.2)) for name in lengths}
        if shape == "box":
            size["size"] = draw(vectors(3, 1e-4, 1e3, 0.2))
        orientation = draw(vectors(4, -1.0, 1.0, 0.0, 0.5))
        assume(np.linalg.norm(orientation) > 1e-5)
        result.append(
            {
                "type": shape,
                "name": f"{shape}_{i}",
                **size,
                "state": {
                    "position": draw(vectors(3, -1e4, 1e4, 0.0, 0.2)),
                    "orientation": orientation,
                    "linear_velocity": draw(vectors(3, -1e4, 1e4, 0.0)),
                    "angular_velocity": draw(vectors(3, -1e4, 1e4, 0.0)),
                },
                "physics": {
                    "friction": draw(vectors(2, 0.0, 10.0, 0.5)),
                    "mass": draw(near(1e-300, 1e6, 5e-324, 1.0)),
                    "damping": draw(near(-1e5, 0.0, -4.0, -250.0)),
                    "stiffness": draw(near(1e-300, 1e7, 5000.0)),
                },
            }
        )
    camera = {"fovy": draw(near(0.1, 175.0, 45.0)), "orientation": draw(near(-360, 360, 0.0, 90.0))}
    result.append({"type": "camera", **camera, "position": draw(vectors(3, -1e4, 1e4, 0.0, 5e-324, 2.0))})
    result.append({"type": "gravity", "gravity": draw(vectors(3, -1e3, 1e3, 0.0, 1e-320))})
    return result


def points_of(space: Space, seed: int, count: int = 20) -> np.ndarray:
    """Points in the box: inside, on faces and corners."""
    generator = np.random.default_rng(seed)
    points = generator.uniform(0, 1, (count, space.dimension))
    corners = generator.integers(0, 2, points.shape).astype(float)
    return np.where(generator.random((count, 1)) < generator.random((count, space.dimension)), points, corners)


def check_physical(space: Space, u: np.ndarray) -> None:
    batch = space.decode(u)
    for f in dataclasses.fields(batch):
        if f.name in ARRAYS:
            assert np.isfinite(getattr(batch, f.name)).all(), f.name
    extents = {"sphere": 1, "cylinder": 2, "box": 3}
    for i, shape in enumerate(batch.shapes):
        assert (batch.size[:, i, : extents[shape]] > 0).all()
        assert (batch.size[:, i, extents[shape] :] == 0).all()
    np.testing.assert_allclose(np.linalg.norm(batch.quaternion, axis=-1), 1.0, atol=1e-9)
    assert (batch.mass > 0).all()
    assert (batch.damping <= 0).all()
    assert (batch.stiffness > 0).all()
    assert (batch.friction >= 0).all()
    start = batch_from_scenes([space.scene]).friction
    assert (batch.friction <= np.maximum(start, [4.0, 1.0]) + 1e-12).all()
    assert (batch.camera_fovy > 0).all()
    assert (batch.camera_fovy < np.pi).all()
    scale = np.abs(batch.position[..., 2]) + batch.size.max(-1)
    for row in range(len(batch)):
        # A lowest point is a difference: of 1e4 m, 1e-15 of it is left to chance.
        assert (lowest(batch, row) >= -1e-9 - 1e-15 * scale[row]).all()


@settings(max_examples=60)
@given(entries(), st.integers(0, 2**32))
def test_every_point_around_every_readable_scene_is_a_scene(raw, seed):
    scene = scene_from_entries(raw)
    space = Space.around(scene)
    assert np.isfinite(space.sigma).all()
    assert (space.sigma > 0).all()
    assert ((space.start >= 0) & (space.start <= 1)).all()
    assert len(set(space.names)) == space.dimension
    check_physical(space, np.concatenate([space.start[None], points_of(space, seed)]))


AT_THE_LIMIT = dataclasses.replace(
    Scene((body("sphere", clearance=0.0),), CAMERA), gravity=(76.0, 1000.0, 723.103023958465)
)


@settings(max_examples=40)
@given(entries(), st.integers(0, 2**32))
@example(scene_entries(AT_THE_LIMIT), 0)
def test_what_a_search_returns_can_be_written_and_read_again(raw, seed):
    for entry in raw:
        # Heights and spins mix with sizes and turns; their ranges are not the point here.
        if "state" in entry:
            entry["state"]["angular_velocity"] = [
                float(np.clip(v, -90, 90)) for v in entry["state"]["angular_velocity"]
            ]
            entry["state"]["position"][2] = float(np.clip(entry["state"]["position"][2], -90, 90))
    space = Space.around(scene_from_entries(raw))
    for found in (space.scene_at(point) for point in points_of(space, seed, 5)):
        again = scene_from_entries(scene_entries(found))
        np.testing.assert_allclose(numbers(again), numbers(found), rtol=1e-12, atol=1e-12)


@settings(max_examples=50)
@given(entries())
@example(scene_entries(Scene((body("box", clearance=0.0),), CAMERA)))
def test_start_decodes_to_every_scene_that_stands_above_the_floor(raw):
    scene = scene_from_entries(raw)
    lifted = [
        dataclasses.replace(body, position=(*body.position[:2], body.position[2] + max(0.0, -float(low))))
        for body, low in zip(scene.objects, lowest(scene), strict=True)
    ]
    scene = dataclasses.replace(scene, objects=tuple(lifted))
    space = Space.around(scene)
    np.testing.assert_allclose(numbers(space.scene_at(space.start)), numbers(scene), rtol=1e-9, atol=1e-9)


# No redundant direction -------------------------------------------------------------------------------------------------


def visible_pose(batch: SceneBatch, row: int) -> np.ndarray:
    """What an outline can show of the poses: centres, and the axes that are no symmetry's."""
    parts = []
    for i, shape in enumerate(batch.shapes):
        parts.append(batch.position[row, i])
        axes = {"sphere": (), "cylinder": ((0, 0, 1),), "box": ((1, 0, 0), (0, 1, 0), (0, 0, 1))}[shape]
        parts += [rotated(batch.quaternion[row, i], axis) for axis in axes]
    return np.concatenate(parts)


POSE = ("position", "clearance", "yaw", "tilt", "lean")


def pose_jacobian(space: Space, u: np.ndarray) -> np.ndarray:
    """d(visible pose) / d(pose parameters), per metre and radian, by central differences."""
    columns = [j for j, p in enumerate(space.parameters) if p.field in POSE]
    result, step = [], 1e-5
    for j in columns:
        reach = np.zeros(space.dimension)
        reach[j] = step
        middle = np.clip(u, step, 1 - step)
        batch = space.decode(np.stack([middle + reach, middle - reach]))
        result.append((visible_pose(batch, 0) - visible_pose(batch, 1)) / (2 * step * space.parameters[j].span))
    return np.array(result).T


@pytest.mark.parametrize("start", STARTS.values(), ids=STARTS)
def test_pose_parameters_move_the_picture_in_independent_ways_everywhere(start):
    space = Space.around(Scene((start,), CAMERA))
    corners = np.array(np.meshgrid(*[[0.0, 1.0]] * 3)).reshape(3, -1).T
    angles = [j for j, p in enumerate(space.parameters) if p.field in ("yaw", "tilt", "lean")]
    points = [space.start, *points_of(space, 0, 40)]
    for corner in corners:
        point = space.start.copy()
        point[angles] = corner[: len(angles)]
        points.append(point)
    smallest = min(np.linalg.svd(pose_jacobian(space, u), compute_uv=False)[-1] for u in points)
    # Degrees of freedom whose effect is less than a twentieth of the others' are as good as gone.
    assert smallest > 0.05


# Freezing ---------------------------------------------------------------------------------------------------------------


@settings(max_examples=60)
@given(st.sampled_from(sorted(STARTS)), st.integers(0, 2**32))
def test_frozen_parameters_keep_their_values_and_the_others_their_meaning(name, seed):
    space = Space.around(Scene((STARTS[name], dataclasses.replace(body("sphere"), name="other")), CAMERA))
    generator = np.random.default_rng(seed)
    held = generator.random(space.dimension) < generator.uniform(0, 1)
    at, free = generator.uniform(0, 1, (2, space.dimension))
    frozen = space.freeze(held, at, "told so")
    assert frozen.names == tuple(n for n, h in zip(space.names, held, strict=True) if not h)
    assert {n for n, reason in frozen.fixed if reason == "told so"} == set(np.array(space.names)[held])
    whole = np.where(held, at, free)
    np.testing.assert_allclose(
        numbers(frozen.scene_at(free[~held])), numbers(space.scene_at(whole)), rtol=1e-10, atol=1e-10
    )


def test_freezing_twice_is_freezing_both():
    space = Space.around(Scene((STARTS["tilted box"],), CAMERA))
    generator = np.random.default_rng(3)
    u = generator.uniform(0, 1, space.dimension)
    first = generator.random(space.dimension) < 0.4
    once = space.freeze(first, u, "first")
    second = generator.random(once.dimension) < 0.5
    twice = once.freeze(second, u[~first], "second")
    np.testing.assert_allclose(
        numbers(twice.scene_at(u[~first][~second])), numbers(space.scene_at(u)), rtol=1e-10, atol=1e-10
    )
    assert [reason for _, reason in twice.fixed].count("first") == first.sum()


def test_decoding_gives_each_parameter_its_own_value_to_the_bit():
    space = Space.around(Scene((body("box"), dataclasses.replace(body("cylinder"), name="other")), CAMERA))
    u = np.random.default_rng(0).random((37, space.dimension))
    columns = [parameter.from_unit(u[:, j]) for j, parameter in enumerate(space.parameters)]
    np.testing.assert_array_equal(space._from_unit(u), np.stack(columns, 1))


# Errors -----------------------------------------------------------------------------------------------------------------


def test_wrong_points_are_refused():
    space = Space.around(Scene((body("box"),), CAMERA))
    u = space.start
    for wrong in (u[None, :-1], u, u[None, None], u[None] + 2, -u[None] - 1, u[None] * np.nan):
        with pytest.raises(ValueError, match="points"):
            space.decode(wrong)
    with pytest.raises(ValueError, match="points"):
        space.values(u[:-1])
    with pytest.raises(ValueError, match="held"):
        space.freeze(np.zeros(space.dimension + 1, bool), u, "")
    assert len(space.decode(np.zeros((0, space.dimension)))) == 0


def test_wrong_bounds_are_refused():
    good = Parameter("p", "m", "position", (0, 0), 0.5, 0.0, 1.0, 0.1)
    for wrong in ({"start": 2.0}, {"low": 0.5, "high": 0.5}, {"width": 0.0}, {"high": math.inf}, {"offset": 0.0}):
        with pytest.raises(ValueError, match="p:"):
            dataclasses.replace(good, **wrong)


@given(st.floats(0.01, 100), st.floats(0.001, 0.999), st.sampled_from([None, 0.0, 0.05]))
def test_values_and_coordinates_are_each_others_inverse(high, u, offset):
    parameter = Parameter("p", "m", "size", (0, 0), high, high / 50, high, 0.2, offset)
    assert parameter.to_unit(float(parameter.from_unit(np.array(u)))) == pytest.approx(u, abs=1e-9)
