"""A lifted track's place, velocity and acceleration."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from mjx_refine.guess.tracks import Track


@dataclasses.dataclass(frozen=True)
class Motion:
    """A track in space.

    Attributes:
      position: at the first frame of the clip [m].
      velocity: ditto [m/s].
      acceleration: mean over the smooth pieces [m/s^2].
      deceleration: mean loss of speed along the motion [m/s^2].
      fall: median downward acceleration of the pieces that fall, the longer ones counting more [m/s^2].
      weight: how much the acceleration is worth: squared seconds of the pieces.
      points, seconds: of the first piece.
    """

    position: Float[np.ndarray, "3"]
    velocity: Float[np.ndarray, "3"]
    acceleration: Float[np.ndarray, "3"]
    deceleration: float
    fall: float
    weight: float
    points: Float[np.ndarray, "piece 3"]
    seconds: Float[np.ndarray, "piece"]

    def _line(self, pull: float) -> np.ndarray:
        """(place, velocity) at the first frame under a known downward acceleration."""
        lifted = self.points + np.array([0.0, 0.0, 0.5 * pull]) * self.seconds[:, None] ** 2
        return _polynomial(self.seconds, lifted, 1)

    def origin(self, pull: float) -> Float[np.ndarray, "3"]:
        """Place at the first frame, given the downward acceleration ``pull`` [m/s^2]."""
        return self._line(pull)[0]

    def ballistic(self, pull: float) -> Float[np.ndarray, "3"]:
        """Velocity at the first frame, given the downward acceleration ``pull`` [m/s^2]."""
        return self._line(pull)[1]


def _polynomial(t: np.ndarray, points: np.ndarray, degree: int) -> np.ndarray:
    """Coefficients of 1, t, t^2 / 2; missing ones are nought."""
    degree = min(degree, len(t) - 1)
    result = np.zeros((3, points.shape[1]))
    basis = np.stack([t**k / (1, 1, 2)[k] for k in range(degree + 1)], -1)
    result[: degree + 1] = np.linalg.lstsq(basis, points, rcond=None)[0]
    return result


def motions(track: Track, points: Float[np.ndarray, "seen 3"], frames: np.ndarray, fps: float) -> Motion:
    """Motion of lifted ``points`` at ``frames``."""
    seconds = frames / fps
    first = len(track.pieces[0].frames)
    curved = first >= 6
    start = _polynomial(seconds[:first], points[:first], 2 if curved else 1)
    piece = track.pieces[0]
    travel = np.linalg.norm(piece.at(piece.frames[-1]) - piece.at(piece.frames[0]))
    if track.late or (first > 2 and travel < 0.06 * track.diameter + 0.3):
        start = np.stack([points[:first].mean(0), np.zeros(3), np.zeros(3)])
    total, acceleration, loss, moving = 0.0, np.zeros(3), 0.0, 0.0
    falls: list[float] = []
    begin = 0
    for piece in track.pieces:
        part = slice(begin, begin + len(piece.frames))
        begin += len(piece.frames)
        if len(piece.frames) >= 4:
            change = _polynomial(seconds[part] - seconds[part].mean(), points[part], 2)[2]
            falls += [-float(change[2])] * len(piece.frames) * bool(change[2] < 0)
        if len(piece.frames) < 5:
            continue
        middle = seconds[part].mean()
        _, speed, change = _polynomial(seconds[part] - middle, points[part], 2)
        weight = float(np.ptp(seconds[part])) ** 2
        total, acceleration = total + weight, acceleration + weight * change
        away = np.linalg.norm(piece.at(piece.frames[-1]) - piece.at(piece.frames[0]))
        if away > track.diameter:
            norm = max(float(np.linalg.norm(speed)), 1e-9)
            loss, moving = loss - weight * float(change @ speed) / norm, moving + weight
    return Motion(
        position=start[0],
        velocity=start[1],
        acceleration=acceleration / max(total, 1e-12),
        deceleration=loss / max(moving, 1e-12),
        fall=float(np.median(falls)) if falls else 0.0,
        weight=moving,
        points=points[:first],
        seconds=seconds[:first],
    )


def restitution(tracks: tuple[Track, ...]) -> float:
    """Median ratio of upward speeds after to downward speeds before a bounce, in the picture; 0.6 where none is seen."""
    ratios = []
    for track in tracks:
        for before, after in zip(track.pieces[:-1], track.pieces[1:], strict=True):
            moment = (before.frames[-1] + after.frames[0]) / 2
            down, up = before.speed(moment)[1], after.speed(moment)[1]
            if down > 0.5 and up < 0 and len(before.frames) > 2 and len(after.frames) > 2:
                ratios.append(min(-up / down, 0.98))
    return float(np.median(ratios)) if ratios else 0.6
