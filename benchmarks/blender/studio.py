"""Blender as a process that answers jobs."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from benchmarks.clips import rotation
from benchmarks.clips.camera import Camera
from mjx_refine.errors import InputError

WORKER = Path(__file__).with_name("worker.py")
RATE = 240
SAMPLES = 4
MARGIN = 4  # px around what a picture changes


class Studio:
    """A running `worker.py`; use it in a `with`.

    Args:
      python: the interpreter that has `bpy`.

    Raises:
      InputError: that interpreter is not there, or has no `bpy`.
    """

    def __init__(self, python: str = sys.executable):
        self.python, self.version = python, ""
        self._folder = tempfile.TemporaryDirectory(prefix="studio-")
        try:
            self._process = subprocess.Popen(
                [python, str(WORKER)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
            )
        except OSError as error:
            self._folder.cleanup()
            raise InputError(f"--bpy {python}: cannot be run ({error.strerror}); name a Python that has bpy") from error

    def __enter__(self) -> Studio:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            if stream is not None:
                with contextlib.suppress(BrokenPipeError):  # what was left to be written
                    stream.close()
        self._folder.cleanup()

    def _ask(self, job: dict[str, Any]) -> None:
        stdin, stdout = self._process.stdin, self._process.stdout
        if stdin is None or stdout is None:
            raise RuntimeError("Blender's process has no pipes")
        try:
            stdin.write(json.dumps(job) + "\n")
            stdin.flush()
            line = stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            said = self._process.stderr.read() if self._process.stderr else ""
            last = said.strip().splitlines()[-1:] or ["it ended"]
            raise InputError(
                f"--bpy {self.python}: no Blender there ({last[0]}); see benchmarks/blender/requirements.txt"
            )
        answer = json.loads(line)
        if not answer["ok"]:
            raise RuntimeError(f"Blender: {answer['error']}")
        self.version = answer["blender"]

    def simulate(
        self, bodies: list[dict[str, Any]], gravity: float, seconds: float, rate: int = RATE
    ) -> tuple[Float[np.ndarray, "steps bodies 3"], Float[np.ndarray, "steps bodies 4"]]:
        """Positions [m] and quaternions (w x y z) at `rate` steps a second, from time 0 on."""
        out = Path(self._folder.name) / "motion.npz"
        steps = int(np.ceil(seconds * rate))
        self._ask(
            {"do": "simulate", "bodies": bodies, "gravity": gravity, "rate": rate, "steps": steps, "out": str(out)}
        )
        with np.load(out, allow_pickle=False) as data:
            return data["position"], data["quaternion"]

    def render(
        self,
        bodies: list[dict[str, Any]],
        camera: Camera,
        light: dict[str, Any],
        position: Float[np.ndarray, "frames bodies 3"],
        quaternion: Float[np.ndarray, "frames bodies 4"],
    ) -> tuple[UInt8[np.ndarray, "frames height width 3"], Int[np.ndarray, "frames height width"]]:
        """RGB pictures by Cycles, and which body (1, 2, …; 0 none) shows at each pixel's centre."""
        with tempfile.TemporaryDirectory(dir=self._folder.name) as folder:
            poses = Path(folder) / "poses.npz"
            np.savez(poses, position=position, quaternion=quaternion)
            boxes = regions(bodies, camera, light, position)
            shares = boxes / np.array([camera.width, camera.height] * 2)
            self._ask(
                {
                    "do": "render",
                    "bodies": bodies,
                    "camera": {"position": camera.position, "pitch": camera.pitch, "fovy": camera.fovy},
                    "light": light,
                    "poses": str(poses),
                    "out": folder,
                    "size": [camera.width, camera.height],
                    "samples": SAMPLES,
                    "regions": shares.tolist(),
                }
            )
            plate = _read(Path(folder) / "plate.png")[..., :3]
            frames = [_over(plate, _read(Path(folder) / f"rgb_{t:03d}.png")) for t in range(len(position))]
            ids = [_read(Path(folder) / f"id_{t:03d}.png") for t in range(len(position))]
        masks = [np.where(i[..., 3] > 0, i[..., 0], 0).astype(np.int32) for i in ids]
        return np.stack(frames), np.stack(masks)


def regions(
    bodies: list[dict[str, Any]], camera: Camera, light: dict[str, Any], position: Float[np.ndarray, "frames bodies 3"]
) -> Int[np.ndarray, "frames 4"]:
    """The pixels, x0 y0 x1 y1 with y up, that bodies or their shadows can change in each frame."""
    reach = np.array([rotation.bounding_radius({"type": "box", "size": body["size"]}) for body in bodies])
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    points = position[:, :, None] + reach[None, :, None, None] * corners  # cubes around the bodies
    way = np.array(light["way"], float)
    height = np.maximum(points[..., 2:], 0.0)
    shadows = points - way / way[2] * height
    both = np.concatenate([points, shadows], 2).reshape(len(position), -1, 3)
    image = camera.project(both)
    image[image[..., 2] < 0.05] = [0, 0, 1]
    low, high = np.floor(image[..., :2].min(1)) - MARGIN, np.ceil(image[..., :2].max(1)) + MARGIN
    size = np.array([camera.width, camera.height])
    low, high = np.clip(low, 0, size - 2), np.clip(high, 2, size)
    high = np.maximum(high, low + 2)
    return np.stack([low[:, 0], size[1] - high[:, 1], high[:, 0], size[1] - low[:, 1]], 1).astype(int)


def _read(path: Path) -> UInt8[np.ndarray, "height width 4"]:
    picture = cv2.imread(os.fspath(path), cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise RuntimeError(f"Blender wrote no {path.name}")
    return cv2.cvtColor(picture, cv2.COLOR_BGRA2RGBA)


def _over(
    plate: UInt8[np.ndarray, "height width 3"], drawn: UInt8[np.ndarray, "height width 4"]
) -> UInt8[np.ndarray, "height width 3"]:
    return np.where(drawn[..., 3:] > 0, drawn[..., :3], plate)
