"""Wrong inputs and calls, each with what the one line on stderr must say."""

from __future__ import annotations

import copy
import io
import os
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

GONE = object()
ENTRIES: list[dict[str, Any]] = [
    {
        "type": "box",
        "name": "box_0",
        "size": [0.3, 0.2, 0.2],
        "state": {"position": [0.0, 0.5, 0.2], "orientation": [1, 0, 0, 0], "linear_velocity": [1, 0, 0]},
        "physics": {"friction": [0.4, 0.01], "mass": 1.0, "damping": -4},
    },
    {"type": "sphere", "name": "sphere_0", "radius": 0.2, "state": {"position": [0.8, 0.5, 0.2]}},
    {"type": "camera", "fovy": 45, "orientation": 45, "position": [0, -2, 3.5]},
    {"type": "gravity", "gravity": [0, 0, -9.81]},
]


@dataclass(frozen=True)
class Case:
    """One wrong call.

    Attributes:
      name: what is wrong.
      make: writes the files it needs into a folder and returns the arguments; paths are relative to that folder.
      says: regular expressions that the message must match: file, place, value, expectation or remedy.
    """

    name: str
    make: Callable[[Path], list[str]]
    says: tuple[str, ...]


def scene_text(changes: dict[str, Any] | None = None, extra: list[Any] | None = None) -> str:
    """A sound scene as YAML, with changes by dotted path (``0.state.position``); GONE removes."""
    entries = copy.deepcopy(ENTRIES)
    for path, value in (changes or {}).items():
        *parents, last = [int(p) if p.isdigit() else p for p in path.split(".")]
        place: Any = entries
        for parent in parents:
            place = place[parent]
        if value is GONE:
            del place[last]
        else:
            place[last] = value
    return yaml.safe_dump([*entries, *(extra or [])], sort_keys=False)


def arrays(**changes: Any) -> dict[str, Any]:
    """A sound observation's arrays: 4 frames of 24x16; GONE removes."""
    masks = np.zeros((4, 16, 24), np.uint8)
    masks[:, 4:10, 5:12] = 1
    good: dict[str, Any] = {"flow": np.zeros((3, 16, 24, 2), np.float32), "masks": masks, "fps": np.float64(30)}
    return {k: v for k, v in {**good, **changes}.items() if v is not GONE}


def good_files(folder: Path) -> None:
    """``good.yaml`` and ``good.npz``."""
    (folder / "good.yaml").write_text(scene_text())
    np.savez(folder / "good.npz", **arrays())


def zip_member(path: Path, name: str, compressed: bytes, size: int, method: int = 8) -> None:
    """A zip of one member whose headers say what they are told."""
    crc, encoded = zlib.crc32(compressed) if method == 0 else 0, name.encode()
    head = struct.pack("<HHHHHIIIHH", 20, 0, method, 0, 33, crc, len(compressed), size, len(encoded), 0)
    local = b"PK\x03\x04" + head + encoded + compressed
    central = b"PK\x01\x02" + struct.pack("<H", 20) + head + struct.pack("<HHHII", 0, 0, 0, 0, 0) + encoded
    end = b"PK\x05\x06" + struct.pack("<HHHHIIH", 0, 0, 1, 1, len(central), len(local), 0)
    path.write_bytes(local + central + end)


def npy_header(shape: tuple[int, ...], dtype: str) -> bytes:
    """The head of an npy file."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"shape": shape, "fortran_order": False, "descr": dtype})
    return stream.getvalue()


def zip_bomb(path: Path) -> None:
    """3 MB that say and are 3 GB."""
    size = 3_000_000_000
    engine = zlib.compressobj(9, wbits=-15)
    first = engine.compress(npy_header((size,), "|u1")) + engine.flush(zlib.Z_FULL_FLUSH)
    block = engine.compress(bytes(10**7)) + engine.flush(zlib.Z_FULL_FLUSH)
    zip_member(path, "masks.npy", first + block * (size // 10**7) + engine.flush(), size + 128)


def lying_size(path: Path) -> None:
    """A flow whose header and zip entry both promise 3.2 GB that are not there."""
    zip_member(path, "flow.npy", npy_header((10**8, 2, 2), "<f8"), 2**32 - 2, 0)
    fps = io.BytesIO()
    np.save(fps, np.float64(30))
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("fps.npy", fps.getvalue())


def _scene(name: str, text: str | bytes, *says: str) -> Case:
    def make(folder: Path) -> list[str]:
        (folder / "bad.yaml").write_bytes(text if isinstance(text, bytes) else text.encode())
        return ["--init", "bad.yaml", "--video", "good.npz", "--out", "out"]

    return Case(f"scene: {name}", make, (r"bad\.yaml", *says))


def _npz(name: str, write: Callable[[Path], object] | dict[str, Any], *says: str) -> Case:
    def make(folder: Path) -> list[str]:
        path = folder / "bad.npz"
        write(path) if callable(write) else np.savez(path, **write)
        return ["--init", "good.yaml", "--video", "bad.npz", "--out", "out"]

    return Case(f"observation: {name}", make, (r"bad\.npz", *says))


def _bomb() -> str:
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
    return "\n".join(lines)


def _merge_bomb() -> str:
    lines = ["- &m0 {x0: 1}"]
    lines += [f"- &m{i} {{<<: [{', '.join([f'*m{i - 1}'] * 9)}], x{i}: 1}}" for i in range(1, 10)]
    return "\n".join(lines)


def _small_bomb() -> str:
    """Within the limit of nodes, and still too long to print in full."""
    return "- type: sphere\n  radius: &a [" + "9, " * 20000 + "1]\n  state: {position: *a}\n"


SCENES = [
    _scene("empty file", "", "no scene", "expected"),
    _scene("only comments", "# nothing\n---\n", "no scene", "expected"),
    _scene("binary garbage", bytes(range(128, 256)) * 9, "UTF-8", "expected"),
    _scene("UTF-16", scene_text().encode("utf-16"), "UTF-8", "expected"),
    _scene("NUL bytes", b"\0" * 100, "not (safe|readable) YAML", "correct"),
    _scene("truncated YAML", scene_text()[:120] + " [1, 2", "line", "correct"),
    _scene("prose", "I think that the box moves to the left.", "expected a list"),
    _scene("mapping instead of list", "type: box\n", "expected a list"),
    _scene("code injection", "- !!python/object/apply:os.system ['touch owned']\n", "python/object", "safe YAML"),
    _scene("code injection (name)", "- !!python/name:os.system\n", "python/name", "safe YAML"),
    _scene("own tag", "- !rocket {type: box}\n", "rocket", "line 1"),
    _scene("alias bomb", _bomb(), "100000 values", "remove"),
    _scene("merge bomb", _merge_bomb(), "100000 values", "remove"),
    _scene("long list by alias", _small_bomb(), "radius", "expected a number"),
    _scene("alias to itself", "- &a {type: box, state: *a}\n", "itself", "remove"),
    _scene("nesting 100000 deep", "[" * 100_000, "not readable YAML", "correct"),
    _scene("whole number of 5000 digits", scene_text({"1.radius": 0}).replace("radius: 0", "radius: " + "9" * 5000), "digits"),
    _scene("hexadecimal of 9000 digits", scene_text().replace("radius: 0.2", "radius: 0x" + "f" * 9000), "radius", "expected"),
    _scene("whole number of 400 digits", scene_text({"1.radius": 10**400}), r"entry 1 \(sphere_0\)\.radius", "expected"),
    _scene("impossible date", "- type: 2001-99-99\n", "month|not readable", "correct"),
    _scene("unhashable key", "- {[1, 2]: 3}\n", "unhashable", "line 1"),
    _scene("duplicate key", "- type: sphere\n  radius: 1\n  radius: 2\n", "'radius' stands twice", "line 3"),
    _scene("2000000 unclosed thoughts", "<think>" * 2_000_000, "characters", "expected at most"),
    _scene("too large", b"#" * (33 << 20), "32 MiB", "split"),
    _scene("100000 samples", "---\n- 1\n" * 100_000, "100000 samples", "at most 4096"),
    _scene("unknown shape", scene_text({"0.type": "cone"}), r"entry 0\.type = 'cone'", "box", "cylinder"),
    _scene("type is a list", scene_text({"0.type": ["box"]}), r"entry 0\.type", "expected one of"),
    _scene("no type", scene_text({"0.type": GONE}), r"entry 0\.type is missing", "add"),
    _scene("entry is a text", scene_text(extra=["box"]), "entry 4", "expected a mapping"),
    _scene("negative size", scene_text({"0.size": [1, -1, 1]}), r"\(box_0\)\.size\[1\] = -1", "<="),
    _scene("zero radius", scene_text({"1.radius": 0}), r"\(sphere_0\)\.radius = 0", "<="),
    _scene("size of two numbers", scene_text({"0.size": [1, 1]}), r"\.size", "list of 3 numbers"),
    _scene("no position", scene_text({"0.state.position": GONE}), r"\.state\.position is missing", "add"),
    _scene("no size", scene_text({"0.size": GONE}), r"\(box_0\)\.size is missing", "add"),
    _scene("NaN", scene_text({"0.state.position": [0, float("nan"), 0]}), r"position\[1\] = nan", "expected a number"),
    _scene("infinity", scene_text({"0.physics.mass": float("inf")}), r"physics\.mass = inf", "expected"),
    _scene("1e999", scene_text().replace("mass: 1.0", "mass: 1e999"), r"physics\.mass", "expected"),
    _scene("truth value for a number", scene_text({"0.physics.mass": True}), r"physics\.mass = True", "expected"),
    _scene("text for a number", scene_text({"0.physics.mass": "heavy"}), r"physics\.mass = 'heavy'", "expected"),
    _scene("zero mass", scene_text({"0.physics.mass": 0}), r"physics\.mass = 0", "0 < number"),
    _scene("positive damping", scene_text({"0.physics.damping": 4}), r"physics\.damping = 4", "<= 0"),
    _scene("negative friction", scene_text({"0.physics.friction": [-0.2, 0]}), r"friction\[0\] = -0\.2", "0 <="),
    _scene("physics is false", scene_text({"0.physics": False}), r"physics = False", "expected a mapping"),
    _scene("zero quaternion", scene_text({"0.state.orientation": [0, 0, 0, 0]}), "orientation", "not zero"),
    _scene("unknown key", scene_text({"0.colour": "red"}), "unknown key 'colour'", "size", "rename"),
    _scene("unknown key of state", scene_text({"0.state.velocity": [0, 0, 0]}), "unknown key 'velocity'", "rename"),
    _scene("duplicate names", scene_text({"1.name": "box_0"}), "2 objects have the name 'box_0'", "rename"),
    _scene("control characters in a name", scene_text({"0.name": "a\x1b[31m\x07"}), r"entry 0\.name", "printable"),
    _scene("name of 300 characters", scene_text({"0.name": "é" * 300}), r"entry 0\.name", "200 characters"),
    _scene("no camera", scene_text({"2": GONE}), "0 entries of type camera", "exactly one"),
    _scene("two cameras", scene_text(extra=[ENTRIES[2]]), "2 entries of type camera", "exactly one"),
    _scene("two gravities", scene_text(extra=[ENTRIES[3]]), "2 entries of type gravity", "at most one"),
    _scene("no object", scene_text({"0": ENTRIES[3], "3": GONE, "1": ENTRIES[2], "2": GONE}), "no object", "add"),
    _scene("65 objects", scene_text(extra=[{**ENTRIES[1], "name": f"s{i}"} for i in range(63)]), "65 objects", "at most 64"),
    _scene("field of view 0", scene_text({"2.fovy": 0}), r"\(camera\)\.fovy = 0", "expected"),
    _scene("gravity of two numbers", scene_text({"3.gravity": [0, -9.81]}), r"entry 3\.gravity", "3 numbers"),
    _scene("unknown effect key", scene_text(extra=[{"type": "effect", "effect": "drag", "size": 1}]), "key 'size'", "rename"),
    _scene(
        "effect on nobody",
        scene_text(extra=[{"type": "effect", "effect": "drag", "target": "cat"}]), "'cat'", "box_0, sphere_0",
    ),
    _scene(
        "effect with nested parameters",
        scene_text(extra=[{"type": "effect", "effect": "drag", "parameters": {"quadratic": {"a": 1}}}]),
        r"parameters\.quadratic", "expected a number",
    ),
    _scene("effect without a target", scene_text(extra=[{"type": "effect", "effect": "drag"}]), "target is missing", "add"),
    _scene("every answer broken", "<think>so</think><answer>- 1</answer><answer></answer>", "sample 0", "1 more"),
    _scene("unclosed fence", "```yaml\n- type: box\n", "state is missing|size is missing", "add"),
]  # fmt: skip

_FLOW = (3, 16, 24, 2)
_MASKS = (4, 16, 24)
OBSERVATIONS = [
    _npz("empty file", lambda p: p.write_bytes(b""), "npz", "write"),
    _npz("binary garbage", lambda p: p.write_bytes(bytes(range(256)) * 9), "npz", "write"),
    _npz("npy instead of npz", lambda p: p.write_bytes(npy_header((3,), "<f8") + bytes(24)), "npz", "write"),
    _npz("a zip of texts", lambda p: _stored(p, b"no array"), "npz", "write"),
    _npz("a directory", lambda p: p.mkdir(), "is a directory", "expected"),
    _npz("truncated", lambda p: (np.savez(p, **arrays()), os.truncate(p, p.stat().st_size // 2)), "npz", "write"),
    _npz("a flipped byte", lambda p: (np.savez_compressed(p, **arrays()), _flip(p)), "npz", "write"),
    _npz("10 GB header", lambda p: zip_member(p, "flow.npy", npy_header((5, 10**5, 2500), "<f8"), 10**9, 0), "declares", "write"),
    _npz("10 GB header, stored", lambda p: _stored(p, npy_header((1250, 1000, 1000, 1), "<f8")), "flow", "write"),
    _npz("lying size", lying_size, "write"),
    _npz("zip bomb", zip_bomb, "3000000000", "at most"),
    _npz("negative shape", lambda p: _stored(p, npy_header((-3, 16, -24, 2), "<f4") + bytes(9999)), "-3", "write"),
    _npz("header of nonsense", lambda p: _stored(p, b"\x93NUMPY\x01\x00\xf0\x00" + b"-" * 239 + b"\n"), "write"),
    _npz("pickles", arrays(masks=np.array([{"a": 1}], object)), "pickle", "write"),
    _npz("fps as a pickle", arrays(fps=np.array(None, object)), "pickle", "write"),
    _npz("unknown key", arrays(depth=np.zeros(3)), "unknown key 'depth'", "flow_sigma", "rename"),
    _npz("no flow", arrays(flow=GONE), "'flow' is missing", "add"),
    _npz("no fps", arrays(fps=GONE), "'fps' is missing", "add"),
    _npz("no arrays", {}, "npz|missing", "add|write"),
    _npz("fps 0", arrays(fps=0.0), "fps = 0", "0.1 <= fps"),
    _npz("fps NaN", arrays(fps=np.nan), "fps = nan", "0.1 <= fps"),
    _npz("fps of every frame", arrays(fps=np.full(4, 30.0)), r"fps has shape \(4,\)", "one number"),
    _npz("fps as text", arrays(fps="30"), "fps has", "one number"),
    _npz("one frame", arrays(flow=np.zeros((0, 16, 24, 2), "f4"), masks=np.ones((1, 16, 24), int)), "two frames"),
    _npz("flow of one component", arrays(flow=np.zeros((3, 16, 24), "f4")), r"\(3, 16, 24\)", r"\(T-1, H, W, 2\)"),
    _npz("components first", arrays(flow=np.zeros((3, 2, 16, 24), "f4")), "flow has shape", r"\(T-1, H, W, 2\)"),
    _npz("a tiny picture", arrays(flow=np.zeros((3, 4, 4, 2), "f4"), masks=np.ones((4, 4, 4), int)), "4x4", "8x8"),
    _npz("integer flow", arrays(flow=np.zeros(_FLOW, int)), "flow has dtype int64", "float32"),
    _npz("complex flow", arrays(flow=np.zeros(_FLOW, complex)), "flow has dtype complex", "float32"),
    _npz("structured flow", arrays(flow=np.zeros(_FLOW[:3], [("x", "f4"), ("y", "f4")])), "flow has dtype", "float32"),
    _npz("infinite flow", arrays(flow=np.full(_FLOW, np.inf, "f2")), "infinities", "NaN"),
    _npz("flow of 1e300", arrays(flow=np.full(_FLOW, 1e300)), r"1e\+300", "at most"),
    _npz("flow NaN everywhere", arrays(flow=np.full(_FLOW, np.nan), masks=GONE), "NaN everywhere"),
    _npz("masks as numbers", arrays(masks=np.ones(_MASKS)), "masks have dtype float64", "integer"),
    _npz("masks as texts", arrays(masks=np.full(_MASKS, "a")), "masks have dtype", "integer"),
    _npz("one mask too few", arrays(masks=np.ones((3, 16, 24), int)), r"\(3, 16, 24\)", r"expected \(4, 16, 24\)"),
    _npz("masks transposed", arrays(masks=np.ones((4, 24, 16), int)), r"\(4, 24, 16\)", r"expected \(4, 16, 24\)"),
    _npz("empty masks", arrays(masks=np.zeros(_MASKS, int)), "empty in every frame", "refine observe"),
    _npz("negative mask id", arrays(masks=np.full(_MASKS, -1)), r"\[-1, -1\]", "0 <= id"),
    _npz("huge mask id", arrays(masks=np.full(_MASKS, 2**63, "u8")), "9223372036854775808", "id <= "),
    _npz("too many ids", arrays(masks=np.arange(4 * 16 * 24).reshape(_MASKS)), "1535 ids", "at most 64"),
    _npz("pictures as numbers", arrays(frames=np.zeros((*_MASKS, 3))), "frames are float64", "uint8"),
    _npz("grey pictures", arrays(frames=np.zeros(_MASKS, np.uint8)), "frames are uint8", r"\(4, 16, 24, 3\)"),
    _npz("negative sigma", arrays(flow_sigma=-1.0), "flow_sigma", ">= 0"),
    _npz("sigma of a wrong shape", arrays(flow_sigma=np.ones(5)), r"flow_sigma is float64 \(5,\)", "expected"),
    _npz("sigma of 1e300", arrays(flow_sigma=1e300), "flow_sigma", "at most"),
]  # fmt: skip


def _stored(path: Path, content: bytes) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("flow.npy", content)


def _flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[60] ^= 0xFF
    path.write_bytes(bytes(content))
