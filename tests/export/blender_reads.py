"""Opens exported files in Blender and writes down what it sees. Run by Blender, or by a Python that has bpy:

python blender_reads.py -- SEEN.json FRAME,FRAME... FILE...
"""

import json
import sys

import bpy  # pyright: ignore[reportMissingImports]  (only inside Blender)


def open_file(path: str) -> int:
    """Read the file into an empty scene; the frame of Blender that is the motion's first."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = 30
    if path.endswith(".glb"):
        bpy.ops.import_scene.gltf(filepath=path)
    elif path.endswith(".fbx"):
        bpy.ops.import_scene.fbx(filepath=path)
        return 1  # its importer starts at 1
    elif path.endswith(".bvh"):
        bpy.ops.import_anim.bvh(filepath=path, global_scale=0.01, update_scene_duration=True)
        return 1
    else:
        bpy.ops.wm.usd_import(filepath=path)
    return 0


def stored_scales(path: str) -> dict[str, list[float]]:
    """Scale of every node as the FBX file has it; Blender's importer hides a common one."""
    from io_scene_fbx import parse_fbx  # pyright: ignore[reportMissingImports]

    root, _ = parse_fbx.parse(path)
    (objects,) = (element for element in root.elems if element.id == b"Objects")
    scales = {}
    for model in (element for element in objects.elems if element.id == b"Model"):
        (properties,) = (element for element in model.elems if element.id == b"Properties70")
        values = [p.props[4:7] for p in properties.elems if p.props[0] == b"Lcl Scaling"]
        scales[model.props[1].split(b"\0")[0].decode()] = list(values[0]) if values else [1.0, 1.0, 1.0]
    return scales


def look(path: str, frames: list[int]) -> dict:
    first = open_file(path)
    (armature,) = (obj for obj in bpy.data.objects if obj.type == "ARMATURE")
    cameras = [obj.data for obj in bpy.data.objects if obj.type == "CAMERA"]
    heads = {bone.name: [] for bone in armature.data.bones}
    for frame in frames:
        bpy.context.scene.frame_set(first + frame)
        posed = armature.evaluated_get(bpy.context.evaluated_depsgraph_get())
        for bone in posed.pose.bones:
            heads[bone.name].append(list(posed.matrix_world @ bone.head))
    (action,) = bpy.data.actions
    return {
        "mesh_corners_zup_m": {
            obj.name: [list(obj.matrix_world @ vertex.co) for vertex in obj.data.vertices[:8]]
            for obj in bpy.data.objects
            if obj.type == "MESH"
        },
        "stored_scales": stored_scales(path) if path.endswith(".fbx") else {},
        "action_frames": [frame - first for frame in action.frame_range],
        "heads_zup_m": heads,
        "limbs": {
            bone.name: [list(bone.head_local), list(bone.tail_local), bone.parent and bone.parent.name]
            for bone in armature.data.bones
        },
        "cameras": [
            [lens.sensor_fit, lens.lens, lens.sensor_width, lens.sensor_height, lens.clip_end] for lens in cameras
        ],
    }


seen, frames, *files = sys.argv[sys.argv.index("--") + 1 :]
found = {path: look(path, [int(frame) for frame in frames.split(",")]) for path in files}
with open(seen, "w", encoding="utf-8") as stream:
    json.dump(found, stream)
