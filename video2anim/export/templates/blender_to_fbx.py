"""Turns a character .glb of video2anim into .fbx. Run by Blender 4.2 or later, or by a Python that has bpy:

blender --background --python blender_to_fbx.py -- person_1.glb person_1.fbx
python blender_to_fbx.py -- person_1.glb person_1.fbx
"""

import datetime
import sys
import types

import bpy  # pyright: ignore[reportMissingImports]  (only inside Blender)

FPS = 30  # of every motion of video2anim


class FixedTime(datetime.datetime):
    """The file's time stamp, so that the same motion makes the same bytes."""

    @classmethod
    def now(cls, tz=None):
        return cls(2000, 1, 1)


def import_character(path: str) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = FPS
    known = bpy.ops.import_scene.gltf.get_rna_type().properties.keys()
    options: dict[str, str | bool] = {"bone_heuristic": "BLENDER"}  # the joints' y axes lie along the limbs
    if "disable_bone_shape" in known:  # else a ball for drawing the bones is exported as a mesh
        options["disable_bone_shape"] = True
    bpy.ops.import_scene.gltf(filepath=path, **options)
    for obj in list(bpy.data.objects):
        if obj.type not in ("ARMATURE", "MESH") or (obj.type == "MESH" and obj.find_armature() is None):
            bpy.data.objects.remove(obj)
    (action,) = bpy.data.actions
    first, last = action.frame_range
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = round(first), round(last)


def export_fbx(path: str) -> None:
    from io_scene_fbx import export_fbx_bin  # pyright: ignore[reportMissingImports]

    export_fbx_bin.datetime = types.SimpleNamespace(datetime=FixedTime)
    bpy.ops.export_scene.fbx(
        filepath=path,
        object_types={"ARMATURE", "MESH"},
        apply_scale_options="FBX_SCALE_ALL",  # units in the file's header, not as a scale of 100 on the armature
        add_leaf_bones=False,
        bake_anim=True,
        bake_anim_use_all_actions=False,
        bake_anim_use_nla_strips=False,
        bake_anim_force_startend_keying=True,
        bake_anim_simplify_factor=0.0,
    )


if "--" not in sys.argv or len(sys.argv[sys.argv.index("--") + 1 :]) != 2:
    sys.exit("usage: blender --background --python blender_to_fbx.py -- IN.glb OUT.fbx")
source, target = sys.argv[sys.argv.index("--") + 1 :]
import_character(source)
export_fbx(target)
