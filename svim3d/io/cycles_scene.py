"""Blender's Cycles, told what to render: run by an interpreter that has `bpy`, never imported here.

    PYTHON -I cycles_scene.py FOLDER

Reads the exchange folder that `svim3d.io.cycles` writes and puts `LIGHT_VIEW.exr` into it: linear
radiance, premultiplied by coverage, 32-bit R, G, B, A. Positions and cameras are taken as they are,
since both programs' cameras look down -z with y up; only the lookup into the light is turned, whose
pictures Blender holds with z up. The last line of its output says what went wrong.
"""

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

try:
    import bpy  # type: ignore[import-not-found, unused-ignore]
    from mathutils import Matrix  # type: ignore[import-not-found, unused-ignore]
except ImportError as problem:
    sys.exit(f"it cannot import bpy ({problem})")

IOR = 1.5  # reflectance 0.04 at normal incidence, as in glTF
MAX_BOUNCES = 6
SEEDS = 1 << 31
GPU_KINDS = ("OPTIX", "CUDA", "HIP", "ONEAPI", "METAL")
# Rows: Blender's lookup (x, y, z) for a direction of ours, whose lat-long pictures have -z in the
# middle and +x to the right of it; Blender's have +x in the middle, -y to the right, +z on top.
BLENDER_FROM_OURS = ((0.0, 0.0, -1.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


def main(folder: Path) -> None:
    """Render all views in all lights."""
    told = json.loads((folder / "scene.json").read_text())
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    set_up_cycles(scene, told)
    add_object(scene, np.load(folder / "corners.npz"))
    environment = add_light(scene)
    camera = add_camera(scene, math.radians(told["fov_y_deg"]))
    for light in range(told["lights"]):
        image = bpy.data.images.load(str(folder / f"light_{light}.exr"))
        image.colorspace_settings.name = "Non-Color"  # as it is
        environment.image = image
        for view, pose in enumerate(told["cameras"]):
            camera.matrix_world = Matrix(pose)
            # Of its own for each picture, so that the noise of no two of them is alike.
            scene.cycles.seed = (told["seed"] + light * len(told["cameras"]) + view) % SEEDS
            scene.render.filepath = str(folder / f"{light}_{view}.exr")
            bpy.ops.render.render(write_still=True)


def set_up_cycles(scene: Any, told: dict[str, Any]) -> None:
    """Equal numbers of unclamped samples, box filtered, to linear 32-bit files."""
    render, cycles = scene.render, scene.cycles
    render.engine = "CYCLES"
    render.resolution_x = render.resolution_y = told["size"]
    render.resolution_percentage = 100
    render.film_transparent = True
    render.use_persistent_data = True  # the mesh is handed over once, not for every picture
    # As many processes as cores are started, so each has one thread.
    render.threads_mode, render.threads = "FIXED", 1
    settings = render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGBA", "32"
    cycles.samples = told["samples"]
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = False
    cycles.pixel_filter_type = "BOX"
    cycles.max_bounces = MAX_BOUNCES
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.blur_glossy = 0.0
    if told["device"] == "gpu":
        use_gpu(cycles)


def use_gpu(cycles: Any) -> None:
    """Render on every GPU of the first kind that Cycles finds."""
    preferences = bpy.context.preferences.addons["cycles"].preferences
    for kind in GPU_KINDS:
        found = [d for d in preferences.get_devices_for_type(kind) if d.type == kind]
        if found:
            preferences.compute_device_type = kind
            for device in found:
                device.use = True
            cycles.device = "GPU"
            return
    sys.exit("Cycles finds no GPU; use --cycles-device cpu")


def add_object(scene: Any, corners: Any) -> None:
    """Triangles that share nothing, with normals and materials at their corners."""
    position = corners["position"].reshape(-1, 3)
    count = len(position)
    mesh = bpy.data.meshes.new("object")
    mesh.vertices.add(count)
    mesh.vertices.foreach_set("co", position.ravel())
    mesh.loops.add(count)
    mesh.loops.foreach_set("vertex_index", np.arange(count, dtype=np.int32))
    mesh.polygons.add(count // 3)
    mesh.polygons.foreach_set("loop_start", np.arange(0, count, 3, dtype=np.int32))
    mesh.update(calc_edges=True)
    mesh.shade_smooth()
    mesh.normals_split_custom_set_from_vertices(corners["normal"].reshape(-1, 3))
    for name in ("basecolor", "roughness", "metallic"):
        values = np.broadcast_to(corners[name].reshape(count, -1), (count, 3))
        rgba = np.concatenate([values, np.ones((count, 1))], 1, dtype=np.float32)
        attribute = mesh.attributes.new(name, "FLOAT_COLOR", "POINT")
        attribute.data.foreach_set("color", rgba.ravel())
    mesh.materials.append(material())
    scene.collection.objects.link(bpy.data.objects.new("object", mesh))


def material() -> Any:
    """The metallic-roughness surface of glTF, read from the corners."""
    made = bpy.data.materials.new("surface")
    made.use_nodes = True
    nodes, links = made.node_tree.nodes, made.node_tree.links
    surface = nodes["Principled BSDF"]
    surface.inputs["IOR"].default_value = IOR
    for name, socket in (
        ("basecolor", "Base Color"),
        ("roughness", "Roughness"),
        ("metallic", "Metallic"),
    ):
        reader = nodes.new("ShaderNodeAttribute")
        reader.attribute_name = name
        output = "Color" if name == "basecolor" else "Fac"
        links.new(reader.outputs[output], surface.inputs[socket])
    return made


def add_light(scene: Any) -> Any:
    """An environment; returns the node that holds its picture."""
    scene.world = bpy.data.worlds.new("light")
    scene.world.use_nodes = True
    nodes, links = scene.world.node_tree.nodes, scene.world.node_tree.links
    direction = nodes.new("ShaderNodeTexCoord")
    turn = nodes.new("ShaderNodeMapping")
    turn.inputs["Rotation"].default_value = Matrix(BLENDER_FROM_OURS).to_euler()
    environment = nodes.new("ShaderNodeTexEnvironment")
    links.new(direction.outputs["Generated"], turn.inputs["Vector"])
    links.new(turn.outputs["Vector"], environment.inputs["Vector"])
    links.new(environment.outputs["Color"], nodes["Background"].inputs["Color"])
    return environment


def add_camera(scene: Any, fov: float) -> Any:
    """A square pinhole camera of a field of view in radians."""
    lens = bpy.data.cameras.new("camera")
    lens.lens_unit, lens.angle = "FOV", fov
    lens.clip_start, lens.clip_end = 0.05, 100.0
    scene.camera = bpy.data.objects.new("camera", lens)
    scene.collection.objects.link(scene.camera)
    return scene.camera


if __name__ == "__main__":
    main(Path(sys.argv[1]))
