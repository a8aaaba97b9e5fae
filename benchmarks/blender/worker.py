"""Blender's side: rigid bodies and pictures. Runs in an environment with `bpy`, apart from the rest of the project.

`bpy` wants another NumPy than JAX does, so this file imports nothing of the project. It reads a job as JSON a line on
standard input and answers with a line of JSON (Blender's own chatter goes nowhere):

    {"do": "simulate", "bodies": [...], "gravity": -9.81, "rate": 240, "steps": 240, "out": "motion.npz"}
    {"do": "render", "bodies": [...], "camera": {...}, "light": {...}, "poses": "poses.npz", "out": "folder"}

A body: type (sphere, box, cylinder), size (half extents m, of the box that holds it), position, quaternion (w x y z),
velocity m/s and spin rad/s (world frame), mass kg, friction, restitution, colour (linear RGB), metal, speckle.
"""

import json
import math
import os
import sys

import bpy
import numpy as np
from mathutils import Matrix, Quaternion, Vector

LEAD = 8  # steps during which bodies are carried, so that Bullet learns their velocities
FIRST = 1  # Blender's frames begin here
SMOOTH = 128  # sides of a round body's mesh


def empty_scene():
    """A new scene with nothing in it."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return bpy.context.scene


def add_body(body):
    """The mesh of a body about its centre, axis z; its object is not scaled."""
    x, y, z = (float(v) for v in body["size"])
    if body["type"] == "sphere":
        bpy.ops.mesh.primitive_uv_sphere_add(segments=SMOOTH, ring_count=SMOOTH // 2, radius=x)
    elif body["type"] == "box":
        bpy.ops.mesh.primitive_cube_add(size=1.0)
        bpy.context.object.data.transform(_scaling(2 * x, 2 * y, 2 * z))
    else:
        bpy.ops.mesh.primitive_cylinder_add(vertices=SMOOTH, radius=x, depth=2 * z)
    made = bpy.context.object
    made.rotation_mode = "QUATERNION"
    if body["type"] == "sphere":
        bpy.ops.object.shade_smooth()
    if body["type"] == "cylinder":
        for face in made.data.polygons:
            face.use_smooth = len(face.vertices) == 4
    return made


def _scaling(x, y, z):
    return Matrix.Diagonal((x, y, z, 1.0))


def simulate(job):
    """Positions and quaternions at every step, by Blender's rigid-body world (Bullet)."""
    scene = empty_scene()
    scene.render.fps, scene.render.fps_base = int(job["rate"]), 1.0
    scene.gravity = (0.0, 0.0, float(job["gravity"]))
    last = FIRST + LEAD + int(job["steps"])
    scene.frame_start, scene.frame_end = FIRST, last
    bpy.ops.rigidbody.world_add()
    world = scene.rigidbody_world
    world.substeps_per_frame, world.solver_iterations = 2, 30
    world.point_cache.frame_start, world.point_cache.frame_end = FIRST, last
    bpy.ops.mesh.primitive_cube_add(size=1.0, location=(0, 0, -0.5))
    floor = bpy.context.object
    floor.data.transform(_scaling(60, 60, 1))
    bpy.ops.rigidbody.object_add(type="PASSIVE")
    floor.rigid_body.collision_shape, floor.rigid_body.friction, floor.rigid_body.restitution = "BOX", 1.0, 1.0
    made = [_rigid(body, int(job["rate"])) for body in job["bodies"]]
    position = np.zeros((int(job["steps"]) + 1, len(made), 3))
    quaternion = np.zeros((len(position), len(made), 4))
    for frame in range(FIRST, last + 1):
        scene.frame_set(frame)
        step = frame - FIRST - LEAD
        if step < 0:
            continue
        graph = bpy.context.evaluated_depsgraph_get()
        for i, thing in enumerate(made):
            place, turn, _ = thing.evaluated_get(graph).matrix_world.decompose()
            position[step, i], quaternion[step, i] = place, turn
    np.savez(job["out"], position=position, quaternion=quaternion)


def _rigid(body, rate):
    """A body that is carried through LEAD steps at its velocity and then let go."""
    made = add_body(body)
    bpy.ops.rigidbody.object_add(type="ACTIVE")
    solid = made.rigid_body
    solid.collision_shape = {"sphere": "SPHERE", "box": "BOX", "cylinder": "CYLINDER"}[body["type"]]
    solid.mass, solid.friction, solid.restitution = body["mass"], body["friction"], body["restitution"]
    solid.linear_damping, solid.angular_damping = body["linear_damping"], body["angular_damping"]
    solid.use_deactivation = False
    start, turn = Vector(body["position"]), Quaternion(body["quaternion"])
    velocity, spin = Vector(body["velocity"]), Vector(body["spin"])
    for lead in range(LEAD + 1):
        seconds = (lead - LEAD) / rate
        made.location = start + velocity * seconds
        turned = Quaternion(spin.normalized(), spin.length * seconds) if spin.length > 0 else Quaternion()
        made.rotation_quaternion = turned @ turn
        made.keyframe_insert("location", frame=FIRST + lead)
        made.keyframe_insert("rotation_quaternion", frame=FIRST + lead)
    solid.kinematic = True
    solid.keyframe_insert("kinematic", frame=FIRST)
    solid.kinematic = False
    solid.keyframe_insert("kinematic", frame=FIRST + LEAD)
    return made


def render(job):
    """Pictures `rgb_NNN.png` (transparent where nothing can have changed), `plate.png` without bodies, `id_NNN.png`."""
    scene, data = empty_scene(), np.load(job["poses"])
    _settings(scene, job)
    _camera(scene, job["camera"])
    _stage(scene, job["light"])
    made = [add_body(body) for body in job["bodies"]]
    for index, (thing, body) in enumerate(zip(made, job["bodies"], strict=True)):
        thing.pass_index = index + 1
        thing.data.materials.append(_surface(body))
    for thing in made:
        thing.hide_render = True
    _shoot(scene, None, os.path.join(job["out"], "plate.png"))
    for thing in made:
        thing.hide_render = False
    regions = np.asarray(job["regions"], float)  # (frames, 4): x0, y0, x1, y1, shares of the picture, y up
    poses = list(zip(data["position"], data["quaternion"], regions, strict=True))
    for name in ("rgb", "id"):
        if name == "id":
            _identify(scene)
        for frame, (position, quaternion, region) in enumerate(poses):
            for thing, place, turn in zip(made, position, quaternion, strict=True):
                thing.location, thing.rotation_quaternion = place, turn
            _shoot(scene, region, os.path.join(job["out"], f"{name}_{frame:03d}.png"))


def _settings(scene, job):
    render = scene.render
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y, render.resolution_percentage = *job["size"], 100
    render.threads_mode, render.threads = "FIXED", int(job.get("threads", 1))
    render.use_persistent_data = True
    render.use_compositing = render.use_sequencer = False
    render.image_settings.file_format, render.image_settings.color_mode = "PNG", "RGBA"
    render.image_settings.compression, render.dither_intensity = 0, 0.0
    scene.view_settings.view_transform = "Standard"
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.seed = "CPU", int(job["samples"]), 0
    cycles.use_adaptive_sampling = cycles.use_denoising = cycles.use_auto_tile = cycles.use_light_tree = False
    # Sharp suns and one mirror bounce need no sampling: a few samples a pixel are for edges alone.
    cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces, cycles.transmission_bounces = 1, 0, 1, 0
    cycles.caustics_reflective = cycles.caustics_refractive = False


def _camera(scene, camera):
    data = bpy.data.cameras.new("camera")
    data.sensor_fit, data.angle = "VERTICAL", math.radians(camera["fovy"])
    thing = bpy.data.objects.new("camera", data)
    thing.location, thing.rotation_euler = camera["position"], (math.radians(camera["pitch"]), 0.0, 0.0)
    data.clip_start, data.clip_end = 0.05, 200.0
    scene.collection.objects.link(thing)
    scene.camera = thing


def _stage(scene, light):
    """Floor, a sharp sun, and a sky that only the camera and mirrors see: nothing that would need many samples."""
    sun = bpy.data.lights.new("sun", "SUN")
    sun.energy, sun.angle = light["strength"], 0.0
    thing = bpy.data.objects.new("sun", sun)
    thing.rotation_mode = "QUATERNION"
    thing.rotation_quaternion = Vector((0, 0, -1)).rotation_difference(Vector(light["way"]))
    scene.collection.objects.link(thing)
    world = bpy.data.worlds.new("sky")
    scene.world = world
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (*light["sky"], 1.0)
    world.cycles_visibility.diffuse = False
    world.cycles.sampling_method = "NONE"
    bpy.ops.mesh.primitive_plane_add(size=80.0)
    bpy.context.object.data.materials.append(
        _surface({"colour": light["floor"], "metal": False, "speckle": light["grain"], "grain": 6.0})
    )


def _surface(body):
    """Rubber or metal; a faint speckle in the body's own coordinates."""
    material = bpy.data.materials.new("surface")
    material.use_nodes = True
    tree = material.node_tree
    shader = tree.nodes["Principled BSDF"]
    shader.inputs["Metallic"].default_value = 1.0 if body["metal"] else 0.0
    shader.inputs["Roughness"].default_value = 0.06 if body["metal"] else 0.7
    shader.inputs["Specular IOR Level"].default_value = 0.5 if body["metal"] else 0.0
    noise, mix = tree.nodes.new("ShaderNodeTexNoise"), tree.nodes.new("ShaderNodeMix")
    place = tree.nodes.new("ShaderNodeTexCoord")
    noise.inputs["Scale"].default_value = body.get("grain", 14.0)
    noise.inputs["Detail"].default_value = 2.0
    mix.data_type = "RGBA"
    dark, light = 1 - 2 * body["speckle"], 1 + 2 * body["speckle"]
    tree.links.new(place.outputs["Object"], noise.inputs["Vector"])
    tree.links.new(noise.outputs["Fac"], mix.inputs["Factor"])
    shades = [(*(min(c * factor, 1.0) for c in body["colour"]), 1.0) for factor in (dark, light)]
    ends = [socket for socket in mix.inputs if socket.type == "RGBA"]
    ends[0].default_value, ends[1].default_value = shades
    out = next(socket for socket in mix.outputs if socket.type == "RGBA")
    tree.links.new(out, shader.inputs["Base Color"])
    tree.links.new(out, shader.inputs["Emission Color"])
    shader.inputs["Emission Strength"].default_value = 0.05 if body["metal"] else 0.3  # stands for the sky's light
    return material


def _identify(scene):
    """From now on every body shows its number, seen through the centres of pixels."""
    material = bpy.data.materials.new("number")
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    info, scale = tree.nodes.new("ShaderNodeObjectInfo"), tree.nodes.new("ShaderNodeMath")
    glow, out = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeOutputMaterial")
    scale.operation, scale.inputs[1].default_value = "DIVIDE", 255.0
    tree.links.new(info.outputs["Object Index"], scale.inputs[0])
    tree.links.new(scale.outputs[0], glow.inputs["Color"])
    tree.links.new(glow.outputs[0], out.inputs["Surface"])
    scene.view_layers[0].material_override = material
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0, 0, 0, 1)
    scene.view_settings.view_transform = "Raw"
    scene.cycles.samples, scene.cycles.pixel_filter_type, scene.cycles.filter_width = 1, "BOX", 0.01
    scene.cycles.max_bounces = 0


def _shoot(scene, region, path):
    render = scene.render
    render.use_border = region is not None
    if region is not None:
        render.border_min_x, render.border_min_y, render.border_max_x, render.border_max_y = (float(v) for v in region)
    render.filepath = path
    bpy.ops.render.render(write_still=True)


def main():
    """Answers jobs until standard input ends."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    for line in sys.stdin:
        job = json.loads(line)
        try:
            {"simulate": simulate, "render": render}[job["do"]](job)
            answer = {"ok": True, "blender": bpy.app.version_string}
        except Exception as error:
            answer = {"ok": False, "error": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
