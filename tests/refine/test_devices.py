"""Several devices: the candidates are dealt out, and the poses are those of one device."""

import json
import os
import subprocess
import sys

import jax
import numpy as np
import pytest

from mjx_refine.batch import batch_from_scenes
from mjx_refine.sim.devices import Devices
from mjx_refine.sim.mjx import MjxSimulator, padded

PROGRAM = """
import json, sys
import jax
import numpy as np
from mjx_refine.compile_cache import enable_cache
from mjx_refine.sim.devices import Devices
from mjx_refine.sim.mjx import MjxSimulator
sys.path.insert(0, "tests/refine")
from test_devices import batch_of

enable_cache()
batch = batch_of(5)
several = MjxSimulator(batch.shapes, 30.0)
one = MjxSimulator(batch.shapes, 30.0, devices=Devices(jax.devices()[:1]))
parts = []
inner = several.devices.spread
def watched(function):
    def part(leaves, qpos, qvel):
        parts.append(len(qpos))
        return function(leaves, qpos, qvel)
    return inner(part)
several.devices.spread = watched
poses, alone = several.rollout(batch, 6), one.rollout(batch, 6)
dealt = several.devices.dealt(np.arange(8.0))
print(json.dumps({
    "devices": len(jax.devices()), "names": [several.device, one.device], "parts": parts,
    "shape": poses.shape, "difference": float(np.abs(poses - alone).max()),
    "moved": float(np.abs(poses[:, 5] - poses[:, 0]).max()),
    "apart": float(np.abs(poses[0] - poses[4]).max()),
    "shards": [[shard.device.id, np.asarray(shard.data).tolist()] for shard in dealt.addressable_shards],
}))
"""


def batch_of(count: int):
    """Candidates that differ: a sphere that slides, and rolls more and more."""
    from own_clip import CAMERA

    from mjx_refine.scene import Body, Scene

    def scene(k: int) -> Scene:
        ball = Body("sphere", "ball", (0.2,), (-0.5, 0.3, 0.2), linear_velocity=(2.0 + 0.3 * k, 0.1 * k, 0.0))
        return Scene((ball,), CAMERA, (0.0, 0.0, -9.81))

    return batch_from_scenes([scene(k) for k in range(count)])


def test_batches_are_padded_to_a_multiple_of_the_devices():
    batch = batch_of(5)
    assert [len(padded(batch, n)) for n in (1, 2, 3, 4, 16)] == [16, 16, 18, 16, 16]
    assert [len(padded(batch[:1], n)) for n in (1, 3, 8)] == [1, 3, 8]
    full = padded(batch, 3)
    assert np.array_equal(full.position[:5], batch.position)
    assert (full.position[5:] == batch.position[4]).all()


def test_one_device_is_left_alone():
    devices = Devices(jax.devices()[:1])
    assert (len(devices), devices.name) == (1, "cpu")
    assert devices.spread(len) is len
    assert MjxSimulator(("sphere",), 30.0).device == Devices().name


@pytest.mark.timeout(300)
def test_four_devices_give_what_one_gives():
    path = os.pathsep.join(os.path.abspath(entry or ".") for entry in sys.path)
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4"
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=280,
        env={**os.environ, "PYTHONPATH": path, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    told = json.loads(done.stdout.splitlines()[-1])
    assert told["devices"] == 4
    assert told["names"] == ["4 x cpu", "cpu"]
    assert set(told["parts"]) == {4}  # 5 candidates, padded to 16, 4 a device
    assert told["shape"] == [5, 6, 1, 7]
    assert told["shards"] == [[0, [0, 1]], [1, [2, 3]], [2, [4, 5]], [3, [6, 7]]]
    assert told["moved"] > 0.2
    assert told["apart"] > 0.05
    assert told["difference"] < 1e-5
