"""Makes keyframes as an animator does in Blender. Run by a Python that has bpy:

python blender_character.py -- OUT.glb            a character of Blender's own, three poses keyed by hand
python blender_character.py -- OUT.glb IN.glb     a file of this project, imported and exported again
"""

import math
import sys

import bpy  # pyright: ignore[reportMissingImports]  (only inside Blender)

KEYS = (1, 31, 76)
BONES = {
    "hips": (None, (0, 0, 0.95), (0, 0, 1.05)),
    "spine": ("hips", (0, 0, 1.05), (0, 0, 1.25)),
    "chest": ("spine", (0, 0, 1.25), (0, 0, 1.45)),
    "neck": ("chest", (0, 0, 1.45), (0, 0, 1.55)),
    "head": ("neck", (0, 0, 1.55), (0, 0, 1.75)),
}
for side, x in (("L", 1), ("R", -1)):
    BONES |= {
        f"thigh.{side}": ("hips", (0.09 * x, 0, 0.9), (0.09 * x, 0, 0.48)),
        f"shin.{side}": (f"thigh.{side}", (0.09 * x, 0, 0.48), (0.09 * x, 0, 0.08)),
        f"foot.{side}": (f"shin.{side}", (0.09 * x, 0, 0.08), (0.09 * x, -0.13, 0.02)),
        f"toe.{side}": (f"foot.{side}", (0.09 * x, -0.13, 0.02), (0.09 * x, -0.2, 0.02)),
        f"shoulder.{side}": ("chest", (0.03 * x, 0, 1.42), (0.17 * x, 0, 1.42)),
        f"upper_arm.{side}": (f"shoulder.{side}", (0.17 * x, 0, 1.42), (0.45 * x, 0, 1.42)),
        f"forearm.{side}": (f"upper_arm.{side}", (0.45 * x, 0, 1.42), (0.7 * x, 0, 1.42)),
        f"hand.{side}": (f"forearm.{side}", (0.7 * x, 0, 1.42), (0.8 * x, 0, 1.42)),
    }


def character() -> None:
    """Armature, facing -Y as Blender's characters do, with a skin of one triangle a bone."""
    bpy.ops.object.armature_add()
    rig = bpy.context.object
    bpy.ops.object.mode_set(mode="EDIT")
    bones = rig.data.edit_bones
    bones.remove(bones[0])
    for name, (parent, head, tail) in BONES.items():
        bone = bones.new(name)
        bone.head, bone.tail = head, tail
        bone.parent = bones[parent] if parent else None
    bpy.ops.object.mode_set(mode="OBJECT")
    mesh = bpy.data.meshes.new("skin")
    corners = [
        (head[0] + dx, head[1] + dy, head[2])
        for _, head, _ in BONES.values()
        for dx, dy in ((0, 0), (0.02, 0), (0, 0.02))
    ]
    mesh.from_pydata(corners, [], [(3 * i, 3 * i + 1, 3 * i + 2) for i in range(len(BONES))])
    skin = bpy.data.objects.new("skin", mesh)
    bpy.context.collection.objects.link(skin)
    for i, name in enumerate(BONES):
        skin.vertex_groups.new(name=name).add([3 * i, 3 * i + 1, 3 * i + 2], 1.0, "REPLACE")
    skin.modifiers.new("armature", "ARMATURE").object = rig
    skin.parent = rig
    for frame, forward, knee in zip(KEYS, (0.0, 0.6, 1.4), (0.0, 0.8, 0.0), strict=True):
        for bone in rig.pose.bones:
            bone.rotation_mode = "QUATERNION"
            bone.keyframe_insert("rotation_quaternion", frame=frame)
        hips, shin = rig.pose.bones["hips"], rig.pose.bones["shin.L"]
        hips.location = (0, 0, forward)  # the bone's own axes: its z is -Y of the world
        hips.keyframe_insert("location", frame=frame)
        shin.rotation_quaternion = (math.cos(knee / 2), math.sin(knee / 2), 0, 0)
        shin.keyframe_insert("rotation_quaternion", frame=frame)


out, *given = sys.argv[sys.argv.index("--") + 1 :]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps = 30
if given:
    bpy.ops.import_scene.gltf(filepath=given[0])
else:
    character()
bpy.ops.export_scene.gltf(
    filepath=out, export_format="GLB", export_yup=True, export_skins=True, export_animations=True, export_extras=True,
    export_force_sampling=bool(given),
)  # fmt: skip
