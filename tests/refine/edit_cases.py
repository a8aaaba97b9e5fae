"""Instructions, each with the exact lines that it changes (a unified diff without context), and those that are refused."""

from __future__ import annotations

from pathlib import Path

TEXT = """\
# A box runs into a ball.
- type: box                  # the runner
  name: box_0
  size: [0.3, 0.25, 0.2]     # half extents
  state:
    position: [-1.5, 0.3, 0.2]
    orientation: [1, 0, 0, 0]
    linear_velocity: [4.0, -0.5, 0.0]   # m/s
    angular_velocity: [0, 0, 2]
  physics:
    friction: [0.4, 0.01]
    mass: 1.5
    damping: -20

- type: sphere
  name: sphere_0
  radius: 0.2
  state: {position: [0.4, 0.4, 0.7]}
- type: cylinder
  name: can
  radius: 0.15
  height: 0.5
  state:
    position:
      - 1.5
      - 1
      - 0.25
    linear_velocity: [0, -1, 0]
  physics: {mass: 2, friction: [0.6, 0.02]}
# where it is seen from
- {type: camera, fovy: 45, orientation: 45, position: [0, -2, 3.5]}
"""


def _edits() -> list[tuple[str, str]]:
    """From ``edits.diff.txt``: after ``> `` an instruction (with ``\\n`` for a line's end), then its diff."""
    parts = ("\n" + Path(__file__).with_name("edits.diff.txt").read_text()).split("\n> ")[1:]
    pairs = (part.split("\n", 1) for part in parts)
    return [(instruction.replace("\\n", "\n"), lines.rstrip("\n") + "\n") for instruction, lines in pairs]


EDITS = _edits()
"""(instruction, unified diff without context and names) on ``TEXT``."""

REFUSED: list[tuple[str, str]] = [
    ("make the box dance", "not understood"),
    ("make box_0 heavier", "not understood"),
    ("box_0", "not understood"),
    ("reduce box_0 by 80%", "not understood"),
    ("reduce the velocity of nothing by 80%", "not understood"),
    ("reduce the colour of box_0 by 80%", "not understood"),
    ("reduce the x-velocity of box_0", "not understood"),
    ("reduce the x-velocity of box_0 by a bit", "not understood"),
    ("set the bounce of can to 0.5", "not understood"),
    ("set the size of box_0 to 3 m", "not understood"),
    ("paint the ball red", "not understood"),
    ("gravity", "not understood"),
    ("increase gravity a lot", "not understood"),
    ("tilt the camera by 10 degrees", "not understood"),
    ("roll the camera by 10 degrees", "not understood"),
    ("move the box somewhere else", "not understood"),
    ("move box_0 to [1, 2]", "not understood"),
    ("launch box_0 forwards at 2 m/s", "not understood"),
    ("scale the mass of box_0 by 2 kg", "not understood"),
    ("do not stop the box", "not understood"),
    ("double the mass of box_0 and dance", "not understood"),
    ("reverse the mass of box_0", "not understood"),
    ("print the scene", "not understood"),
    ("double double the mass of box_0", "not understood"),
    ("halve the mass of box_1", "not understood"),
    ("double its mass", "nothing named before"),
    ("remove the cylinder and the box; stop the box", "may be nothing"),
    ("set the mass of box_0 to 0", "mass = 0"),
    ("set the mass of box_0 to 3 m/s", "correct the unit"),
    ("set the friction of the box to 20", "0 <= number <= 10"),
    ("set the damping of can to 5", "<= 0"),
    ("lower sphere_0 by 1 m", "deep in the floor"),
    ("move the ball to [-1.5, 0.3, 0.2]", "deep in"),
    ("copy can as box_0", "already"),
    ("reduce the speed of sphere_0 by 2 m/s", "lower the amount"),
    ("reduce the mass of box_0 by 120%", "0 to 100 percent"),
    ("set the speed of sphere_0 to 2 m/s", "launch sphere_0"),
    ("set the radius of the box to 1 m", "is a box"),
    ("make the ball 100% smaller", "above 0"),
    ("remove everything", "no object"),
    ("set the field of view to 190 degrees", "fovy = 190"),
]
"""Each with what the message must say."""
