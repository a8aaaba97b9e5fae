"""The one exception that says: the input or the call was wrong."""

from __future__ import annotations


class InputError(ValueError):
    """An input file, an argument or a call was wrong.

    The message is one line that names the file and the place in it, what stood there, what was expected, and the
    remedy, for example ``scene.yaml: entry 2 (box_0).physics.friction[0] = -0.2; expected 0 <= friction <= 10``.
    The command line prints it and exits with status 2.
    """

    def __init__(self, message: str):
        super().__init__(" ".join(str(message).split()))
