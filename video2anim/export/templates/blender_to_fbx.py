"""Turns a character .glb of video2anim into .fbx. Run by Blender:

blender --background --python blender_to_fbx.py -- person_1.glb person_1.fbx
"""

import sys

import bpy  # pyright: ignore[reportMissingImports]  (only inside Blender)

if "--" not in sys.argv or len(sys.argv[sys.argv.index("--") + 1 :]) != 2:
    sys.exit("usage: blender --background --python blender_to_fbx.py -- IN.glb OUT.fbx")
source, target = sys.argv[sys.argv.index("--") + 1 :]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps = 30
bpy.ops.import_scene.gltf(filepath=source)
bpy.ops.export_scene.fbx(
    filepath=target,
    object_types={"ARMATURE", "MESH"},
    add_leaf_bones=False,
    bake_anim=True,
    bake_anim_use_all_actions=False,
    bake_anim_use_nla_strips=False,
    bake_anim_simplify_factor=0.0,
)
