"""Run by Blender's Python: import a .glb or .usdc, write what Blender holds of it as .npz.

Arguments: the file, the .npz, and the pixels of a side of a baked normal map, 0 for none.
"""

import json
import sys
from pathlib import Path

import bpy
import numpy as np


def linked(socket):
    return socket.links[0].from_node if socket.links else None


def upstream(node, kind):
    """Return the first node of a kind that a node's inputs come from."""
    pending = [node]
    while pending:
        one = pending.pop()
        if one.bl_idname == kind:
            return one
        pending += [link.from_node for entry in one.inputs for link in entry.links]
    return None


def pixels(picture):
    """Return what Blender reads of a picture, row 0 at the top, (H, W, 4)."""
    width, height = picture.size
    values = np.empty(width * height * 4, np.float32)
    picture.pixels.foreach_get(values)
    return values.reshape(height, width, 4)[::-1]


def told(item):
    return {
        name: value.to_dict()
        if hasattr(value, "to_dict")
        else value.to_list()
        if hasattr(value, "to_list")
        else value
        for name, value in item.items()
    }


def world(placed, positions):
    matrix = np.array(placed.matrix_world)
    return positions @ matrix[:3, :3].T + matrix[:3, 3]


def baked_normals(placed, material, side):
    """Return the normals that Cycles shades with, world frame, over the texture."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples = "CPU", 1
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    picture = bpy.data.images.new("baked", side, side, float_buffer=True, is_data=True)
    node = material.node_tree.nodes.new("ShaderNodeTexImage")
    node.image = picture
    material.node_tree.nodes.active = node
    bpy.ops.object.select_all(action="DESELECT")
    placed.select_set(True)
    bpy.context.view_layer.objects.active = placed
    bpy.ops.object.bake(
        type="NORMAL",
        normal_space="OBJECT",
        normal_r="POS_X",
        normal_g="POS_Y",
        normal_b="POS_Z",
        margin=0,
        use_clear=True,
    )
    values = pixels(picture)
    normals = (2.0 * values[..., :3] - 1.0) @ np.array(placed.matrix_world)[:3, :3].T
    return normals, values[..., 3] > 0.5


def main(path, out, side):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if path.suffix == ".glb":
        bpy.ops.import_scene.gltf(filepath=str(path))
    elif path.suffix == ".py":  # that an export brings along, beside its file
        exec(compile(path.read_text(), str(path), "exec"), {"__file__": str(path)})
    else:
        bpy.ops.wm.usd_import(filepath=str(path))
    placed = next(one for one in bpy.data.objects if one.type == "MESH")
    mesh, found = placed.data, {}
    positions = np.array([vertex.co for vertex in mesh.vertices])
    found["vertices"] = world(placed, positions)
    found["faces"] = np.array([polygon.vertices for polygon in mesh.polygons])
    layer = mesh.uv_layers.active
    found["uv"] = np.array([corner.uv for corner in layer.data]).reshape(-1, 3, 2)
    shapes = mesh.shape_keys.key_blocks[1:] if mesh.shape_keys else []
    for key in shapes:
        moved = np.array([point.co for point in key.data])
        found[f"shape:{key.name}"] = world(placed, moved) - found["vertices"]
    material = mesh.materials[0]
    surface = next(
        node for node in material.node_tree.nodes if node.bl_idname == "ShaderNodeBsdfPrincipled"
    )
    facts = {
        "shapes": [key.name for key in shapes],
        "weights": [key.value for key in shapes],
        "ior": surface.inputs["IOR"].default_value,
        "method": surface.subsurface_method,
        "subsurface_weight": surface.inputs["Subsurface Weight"].default_value,
        "subsurface_scale": surface.inputs["Subsurface Scale"].default_value,
        "subsurface_radius": list(surface.inputs["Subsurface Radius"].default_value),
        "properties": told(material),
    }
    for name, socket in (
        ("base_color", "Base Color"),
        ("roughness", "Roughness"),
        ("normal", "Normal"),
        ("specular", "Specular IOR Level"),
        ("radius", "Subsurface Radius"),
    ):
        node = linked(surface.inputs[socket])
        picture = node and upstream(node, "ShaderNodeTexImage")
        if picture is None:
            continue
        found[name] = pixels(picture.image)
        facts[f"{name}_space"] = picture.image.colorspace_settings.name
        facts[f"{name}_tiles"] = [tile.number for tile in picture.image.tiles]
        if name == "normal":
            facts["normal_frame"] = upstream(node, "ShaderNodeNormalMap").space
    if side:
        found["baked"], found["baked_covered"] = baked_normals(placed, material, side)
    np.savez(out, facts=json.dumps(facts), **found)


if __name__ == "__main__":
    main(Path(sys.argv[-3]), Path(sys.argv[-2]), int(sys.argv[-1]))
