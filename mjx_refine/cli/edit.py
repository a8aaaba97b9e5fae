"""``refine edit``: a scene changed by an instruction in words."""

from __future__ import annotations

from pathlib import Path

import click

from mjx_refine.cli.types import FiniteFloat, Size
from mjx_refine.errors import InputError

_PATH = click.Path(path_type=Path)


def _print_forms(context: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        from mjx_refine.edit import FORMS

        click.echo("\n".join(FORMS))
        context.exit()


@click.command(context_settings={"show_default": True})
@click.argument("scene", type=_PATH)
@click.argument("instruction")
@click.option("--out", type=_PATH, required=True, help="Where to write the edited scene.")
@click.option("--preview", type=_PATH, help="A picture of before and after: .png, or .gif that moves.")
@click.option("--flow", type=_PATH, help="The edited scene's flow: an .npz, or a new folder for .flo files.")
@click.option("--size", type=Size(), default="480x320", help="Of preview and flow.")
@click.option("--frames", type=click.IntRange(2, 10000), default=30, help="Of preview and flow.")
@click.option("--fps", type=FiniteFloat(0.1, 1e5), default=30.0, help="Of preview and flow.")
@click.option(
    "--forms", is_flag=True, is_eager=True, expose_value=False, callback=_print_forms, help="List what can be said."
)
def edit(scene: Path, instruction: str, out: Path, preview, flow, size, frames: int, fps: float) -> None:
    """Changes a scene as an instruction says, and shows the changed lines.

    refine edit scene.yaml "reduce the x-velocity of box_0 by 80%" --out edited.yaml
    """
    _check_places(scene, out, preview, flow)
    from mjx_refine.scene import load_scene

    load_scene(scene)  # its messages on files that cannot be read
    text = scene.read_bytes().decode("utf-8")

    from mjx_refine.edit import edit as run
    from mjx_refine.files import write_atomic

    result = run(text, instruction, source=str(scene))
    pictures = []
    if preview is not None or flow is not None:
        pictures = _simulated(result, scene, preview is not None, {"size": size, "frames": frames, "fps": fps})
    shown = b"" if preview is None else _sheet(preview, pictures, (result.scene_before.names, result.scene.names))
    write_atomic(out, lambda stream: stream.write(result.after.encode()))
    if flow is not None:
        _write_flow(flow, pictures[-1])
    if preview is not None:
        write_atomic(preview, lambda stream: stream.write(shown))
    diff = result.diff(str(scene), str(out))
    click.echo(diff, nl=False)
    if not diff:
        click.echo("refine: nothing changes: the scene is as the instruction wants it", err=True)


def _check_places(scene: Path, out: Path, preview: Path | None, flow: Path | None) -> None:
    """Refuses places that cannot be written, before anything is made."""
    from mjx_refine.files import writable_file

    writable_file(out)
    if preview is not None:
        if preview.suffix.lower() not in (".png", ".gif"):
            raise InputError(f"--preview {preview}: expected a name that ends in .png or .gif; rename it")
        writable_file(preview)
    if flow is not None and flow.suffix.lower() == ".npz":
        writable_file(flow)
    elif flow is not None:
        from mjx_refine.edit.flo import checked_folder

        checked_folder(flow)
    places = [path.absolute() for path in (out, preview, flow) if path is not None]
    if len(set(places)) < len(places):
        raise InputError(f"{out}: two results in one place; expected a file each; name another")


def _simulated(result, scene: Path, both: bool, options: dict) -> list:
    """Observations of the scene before, where asked for, and after."""
    from mjx_refine.simulate import simulate

    told = []
    for given, what in ((result.scene_before, str(scene)), (result.scene, f"{scene}, edited")):
        if given is result.scene or both:
            try:
                told.append(simulate(given, **options))
            except InputError as error:
                raise InputError(f"{what}: {error}") from error
    return told


def _sheet(preview: Path, pictures: list, names: tuple) -> bytes:
    from mjx_refine.edit import gif_sheet, png_sheet

    return (gif_sheet if preview.suffix.lower() == ".gif" else png_sheet)(pictures[0], pictures[1], names)


def _write_flow(flow: Path, observation) -> None:
    from mjx_refine.edit import write_flo
    from mjx_refine.observation import save_observation

    if flow.suffix.lower() == ".npz":
        save_observation(flow, observation)
    else:
        write_flo(flow, observation.flow)
