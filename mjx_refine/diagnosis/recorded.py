"""The diagnosis of measured poses: of one recording, or of several of one set-up."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mjx_refine.diagnosis.fits.store import Store
from mjx_refine.diagnosis.joint.recordings import diagnose_recordings
from mjx_refine.diagnosis.poses import Poses, diagnose_recording
from mjx_refine.diagnosis.result import Diagnosis
from mjx_refine.scene import Scene


def diagnose_poses(
    scene: Scene | Sequence[Scene],
    poses: Poses | Sequence[Poses],
    *,
    without: tuple[str, ...] = (),
    seed: int = 0,
    threads: int | None = None,
    told: Callable[[str], None] | None = None,
    store: Store | None = None,
) -> Diagnosis:
    """Says where a scene's simulation and measured poses part, which effect parts them, and how far it closes the gap.

    Args:
      scene: sizes, masses, contacts; where its objects start and how fast is taken from the poses. Without effects. Of
        several recordings one for all or one each: they share what the scenes' medians say.
      poses: what was measured; its names are those of objects of the scene. Of several recordings about half are fitted
        and the others judged.
      without: effects to leave out of the catalogue; those of camera and picture always are.
      seed: of everything random.
      threads: of the simulator; all cores by default.
      told: called with a line for each step.
      store: where finished fits are kept, so that an interrupted call goes on; nowhere by default.

    Raises:
      InputError: the scene has effects, the names do not match, nothing moves, or there are too few samples; of several,
        the scenes' objects differ.
    """
    scenes = (scene,) if isinstance(scene, Scene) else tuple(scene)
    recordings = (poses,) if isinstance(poses, Poses) else tuple(poses)
    if len(scenes) == 1 and len(recordings) == 1:
        return diagnose_recording(
            scenes[0], recordings[0], without=without, seed=seed, threads=threads, told=told, store=store
        )
    return diagnose_recordings(scenes, recordings, without=without, seed=seed, threads=threads, told=told, store=store)
