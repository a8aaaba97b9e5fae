"""The same clip at another scale."""

from __future__ import annotations

import dataclasses

from mjx_refine.scene import Scene


def scaled(scene: Scene, factor: float) -> Scene:
    """All lengths times ``factor``; the clip stays the same."""

    def times(v):
        return tuple(c * factor for c in v)

    bodies = tuple(
        dataclasses.replace(
            b,
            size=times(b.size),
            position=times(b.position),
            linear_velocity=times(b.linear_velocity),
            friction=(b.friction[0], b.friction[1] * factor),
        )
        for b in scene.objects
    )
    camera = dataclasses.replace(scene.camera, position=times(scene.camera.position))
    return dataclasses.replace(scene, objects=bodies, camera=camera, gravity=times(scene.gravity))
