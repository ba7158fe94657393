"""Opens a .glb in Blender and writes what is in it as JSON to standard output; run with Blender's own Python.

python blender_scene.py scene.glb
"""

import json
import sys

import bpy


def _facts(thing) -> dict:
    thing.data.update()
    world = [thing.matrix_world @ vertex.co for vertex in thing.data.vertices]
    properties = dict(thing.items())
    slots = [slot.material for slot in thing.material_slots]
    return {
        "matrix": [list(row) for row in thing.matrix_world],
        "low": [min(point[axis] for point in world) for axis in range(3)],
        "high": [max(point[axis] for point in world) for axis in range(3)],
        "faces": len(thing.data.polygons),
        "uv_layers": len(thing.data.uv_layers),
        "materials": [_material(material) for material in slots],
        "properties": {
            key: value for key, value in properties.items() if isinstance(value, str | int | float)
        },
    }


def _material(material) -> dict:
    """Return its name, and the picture of its base color (4 floats a pixel, bottom row first)."""
    shader = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    (link,) = shader.inputs["Base Color"].links
    image = link.from_node.image
    return {"name": material.name, "size": list(image.size), "pixels": list(image.pixels)}


def main() -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=sys.argv[1])
    bpy.context.view_layer.update()
    found = {thing.name: _facts(thing) for thing in bpy.data.objects if thing.type == "MESH"}
    scene = bpy.context.scene
    metres = scene.unit_settings.scale_length if scene.unit_settings.system == "METRIC" else None
    out = {"blender": bpy.app.version_string, "metres_a_unit": metres, "objects": found}
    sys.stdout.write("\nSCENE " + json.dumps(out) + "\n")


if __name__ == "__main__":
    main()
