"""A record: one generated scene with its pictures, states and contacts, as members of a shard.

A record's members share a key and differ in what follows its first dot, as WebDataset has it:

``KEY.yaml``          the scene, as every command reads it.
``KEY.pictures.npz``  ``shape`` (T, H, W), ``fps``; ``runs`` (3, R) as ``Pictures.runs``; ``flow`` (2, 2, M) uint8: low and
                      high bytes of the differences between the bit patterns of neighbours in ``Pictures.flow`` (float16),
                      which deflate to less than half.
``KEY.motion.npz``    ``qpos`` (T, N, 7), ``qvel`` (T, N, 6), and ``contact_`` ``step``, ``pair``, ``points``, ``force``,
                      ``position`` as in ``Contacts``.
``KEY.rgb.jpg``       on request: the T frames one below the other.
``KEY.measured.npz``  with it: ``flow`` (T-1, H, W, 2) float16 and ``flow_sigma`` (T-1, H, W) float16, measured from them.

Whole masks and flow would take 22 MB a record to write and to read, nearly all of it zeros.
"""

from __future__ import annotations

import dataclasses
import functools
import io
import zipfile
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float16, Int, UInt8

from mjx_refine import files
from mjx_refine.errors import InputError
from mjx_refine.generate.npz import packed
from mjx_refine.generate.options import FPS, FRAMES, SIZE
from mjx_refine.generate.physics import Contacts, Motion
from mjx_refine.generate.pictures import Pictures, expanded
from mjx_refine.observation import Observation, save_observation
from mjx_refine.scene import Scene, parse_scenes

PICTURES, MOTION, RGB, MEASURED = "pictures.npz", "motion.npz", "rgb.jpg", "measured.npz"
_CONTACTS = tuple(field.name for field in dataclasses.fields(Contacts))
_QUALITY = 95


@dataclasses.dataclass(frozen=True)
class Seen:
    """What a camera would give.

    Attributes:
      frames: drawn by MuJoCo's renderer, as the shard keeps them (JPEG).
      flow: measured from them [px/frame], NaN where it was not measured.
      sigma: its noise [px].
    """

    frames: UInt8[np.ndarray, "frames height width 3"]
    flow: Float16[np.ndarray, "intervals height width 2"]
    sigma: Float16[np.ndarray, "intervals height width"]


@dataclasses.dataclass(frozen=True)
class Record:
    """One generated scene.

    Attributes:
      key: its number in the split, eight digits.
      text: the scene's YAML.
      pictures: masks and exact flow, where objects are.
      motion: states and contacts.
      seen: drawn frames, and flow measured from them, if they were asked for.
    """

    key: str
    text: str
    pictures: Pictures
    motion: Motion
    seen: Seen | None = None

    @functools.cached_property
    def scene(self) -> Scene:
        """The scene that ``text`` says."""
        return parse_scenes(self.text, f"{self.key}.yaml")[0]

    @functools.cached_property
    def _whole(self) -> tuple[np.ndarray, np.ndarray]:
        return expanded(self.pictures.runs, self.pictures.flow)

    @property
    def masks(self) -> UInt8[np.ndarray, "frames height width"]:
        """0 background, n + 1 the scene's object n."""
        return self._whole[0]

    @property
    def flow(self) -> Float16[np.ndarray, "intervals height width 2"]:
        """Exact flow [px/frame], rounded to float16 or to 1/4096 px, whichever is coarser."""
        return self._whole[1]

    @property
    def observation(self) -> Observation:
        """Masks and exact flow as an observation, with the frames where there are any."""
        frames = None if self.seen is None else self.seen.frames
        return Observation(self.flow.astype(np.float32), self.masks.astype(np.int32), FPS, frames, None, self.key)

    @property
    def measured(self) -> Observation | None:
        """Masks and measured flow with its noise, where the record has frames."""
        if self.seen is None:
            return None
        flow, sigma = self.seen.flow.astype(np.float32), self.seen.sigma.astype(np.float32)
        return Observation(flow, self.masks.astype(np.int32), FPS, self.seen.frames, sigma, self.key)


def members(record: Record) -> dict[str, bytes]:
    """Contents of the record's files by what follows the key; equal records give equal bytes."""
    contacts = {f"contact_{name}": getattr(record.motion.contacts, name) for name in _CONTACTS}
    shape = np.array([FRAMES, SIZE[1], SIZE[0]], np.int32)
    told = {
        "yaml": record.text.encode(),
        PICTURES: packed(
            {
                "shape": shape,
                "fps": np.float64(FPS),
                "runs": record.pictures.runs,
                "flow": differences(record.pictures.flow),
            }
        ),
        MOTION: packed({"qpos": record.motion.qpos, "qvel": record.motion.qvel, **contacts}),
    }
    if record.seen is not None:
        told[RGB] = jpeg(record.seen.frames)
        told[MEASURED] = packed({"flow": record.seen.flow, "flow_sigma": record.seen.sigma})
    return told


def differences(flow: Float16[np.ndarray, "2 pixels"]) -> UInt8[np.ndarray, "2 2 pixels"]:
    """Low and high bytes of what the bit patterns of neighbours differ by."""
    bits = flow.view(np.uint16)
    by = bits.copy()
    np.subtract(bits[:, 1:], bits[:, :-1], out=by[:, 1:])
    return np.stack([by.astype(np.uint8), (by >> 8).astype(np.uint8)])


def summed(parts: UInt8[np.ndarray, "2 2 pixels"]) -> Float16[np.ndarray, "2 pixels"]:
    """The flow of which these are the ``differences``."""
    bits = parts[0] | parts[1].astype(np.uint16) << 8
    return np.cumsum(bits, axis=1, dtype=np.uint16).view(np.float16)


def jpeg(frames: UInt8[np.ndarray, "frames height width 3"]) -> bytes:
    """Frames one below the other in one file."""
    strip = np.ascontiguousarray(frames.reshape(-1, *frames.shape[2:])[..., ::-1])
    return cv2.imencode(".jpg", strip, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()


def from_jpeg(content: bytes) -> UInt8[np.ndarray, "frames height width 3"]:
    """The frames of ``jpeg``."""
    strip = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    if strip is None:
        raise ValueError("no JPEG")
    return np.ascontiguousarray(strip[..., ::-1]).reshape(FRAMES, SIZE[1], SIZE[0], 3)


def from_members(key: str, contents: Mapping[str, bytes], source: str) -> Record:
    """The record that ``members`` wrote.

    Args:
      key: of the record.
      contents: as ``members`` returns them.
      source: the shard, for messages.

    Raises:
      InputError: a member is missing or damaged.
    """
    place = f"{source}: record {key}"
    try:
        pictures, motion = (_unpacked(contents[name]) for name in (PICTURES, MOTION))
        flow, runs = summed(pictures["flow"]), pictures["runs"]
        if tuple(pictures["shape"]) != (FRAMES, SIZE[1], SIZE[0]):
            raise ValueError(f"pictures of shape {pictures['shape'].tolist()}")
        seen = None
        if RGB in contents:
            measured = _unpacked(contents[MEASURED])
            seen = Seen(from_jpeg(contents[RGB]), measured["flow"], measured["flow_sigma"])
        return Record(
            key=key,
            text=contents["yaml"].decode(),
            pictures=Pictures(runs, flow, _pixels(runs, motion["qpos"].shape[1])),
            motion=Motion(motion["qpos"], motion["qvel"], Contacts(*(motion[f"contact_{name}"] for name in _CONTACTS))),
            seen=seen,
        )
    except KeyError as error:
        raise InputError(f"{place}: {error} is missing; expected what `refine generate` writes") from error
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{place}: damaged ({error}); generate the shard again") from error


def _pixels(runs: Int[np.ndarray, "3 runs"], objects: int) -> Int[np.ndarray, "objects"]:
    return np.bincount(runs[2], runs[1], objects + 1)[1:].astype(np.int64)


def _unpacked(content: bytes) -> dict[str, np.ndarray]:
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def save_record(folder: Path, record: Record) -> list[Path]:
    """Writes ``KEY.yaml`` and ``KEY.npz``, which ``refine --init KEY.yaml --video KEY.npz`` takes, and with frames also
    ``KEY.measured.npz``, whose flow is the measured one."""
    written = [files.write_text(folder / f"{record.key}.yaml", record.text)]
    written.append(save_observation(folder / f"{record.key}.npz", record.observation))
    if record.measured is not None:
        written.append(save_observation(folder / f"{record.key}.measured.npz", record.measured))
    return written
