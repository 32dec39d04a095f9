"""USD: the whole scene as one `.usdc` with UsdSkel people. Meters, +Y up, 30 time codes per second.

Needs usd-core, which is imported when this module is.
"""
# usd-core ships no type stubs: its names exist only at run time.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import errno
import re
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdSkel, Vt

from video2anim.export.character import INFLUENCES, Character, Rig
from video2anim.export.frames import is_still, linear_from_srgb, needed_keys, opengl_camera_poses
from video2anim.export.glb import FAR_M, NEAR_M, SKIN_RGB, object_name, plain_name
from video2anim.geometry.rotations import matrix_from_quaternion
from video2anim.geometry.scene_mesh import colored, with_vertex_colors
from video2anim.types import BodyMotion, Mesh, PlacedObject, SceneModel
from video2anim.types.clip import FPS
from video2anim.types.skeleton import JOINT_NAMES, PARENTS

_APERTURE = 0.36
"""Width of the picture: 36 mm in tenths of a scene unit, USD's unit of lenses."""
_BODY_REACH_M = 0.4
"""Skin never lies farther than this from the nearest joint of the 22 (fingertips)."""


def write_usd(path: Path, characters: tuple[Character, ...], scene: SceneModel | None) -> None:
    """Write people, objects, floor, background and camera. `path` ends in `.usdc`, `.usda` or `.usd`.

    Raises:
        OSError: the file cannot be written.
    """
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    stage.SetTimeCodesPerSecond(FPS)
    stage.SetFramesPerSecond(FPS)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    material = _vertex_color_material(stage)
    if scene is not None:
        UsdGeom.Xform.Define(stage, "/World/background")
        for folder, piece in (("", scene.floor), *(("background/", piece) for piece in scene.background)):
            if len(piece.mesh.faces):
                _define_mesh(stage, f"/World/{folder}{plain_name(piece.name)}", colored(piece), material)
        # A folder without a type has no place in space for Blender, which then loses the turn of the up axis below it.
        UsdGeom.Xform.Define(stage, "/World/objects")
        time_s = characters[0].motion.frame_time_s if characters else None
        for placed in scene.objects:
            _define_object(stage, placed, material, time_s)
    for character in characters:
        _define_character(stage, character, material)
    if characters:
        _define_camera(stage, characters[0].motion)
        stage.SetStartTimeCode(float(characters[0].motion.frame_time_s[0]) * FPS)
        stage.SetEndTimeCode(float(characters[0].motion.frame_time_s[-1]) * FPS)
    try:
        stage.GetRootLayer().Export(str(path))
    except Tf.ErrorException as error:
        # Its text is several lines of places in libusd, each with what happened in quotes.
        told = re.findall(r": '(.*)'", str(error)) or [str(error)]
        raise OSError(errno.EIO, told[0], str(path)) from error


def _define_mesh(stage: Usd.Stage, path: str, mesh: Mesh, material: UsdShade.Material) -> UsdGeom.Mesh:
    colors = linear_from_srgb(mesh.vertex_rgb)
    return _define_triangles(stage, path, np.asarray(mesh.vertices_m), np.asarray(mesh.faces), colors, material)


def _define_triangles(
    stage: Usd.Stage,
    path: str,
    vertices_m: np.ndarray,
    faces: np.ndarray,
    colors: np.ndarray,
    material: UsdShade.Material,
) -> UsdGeom.Mesh:
    """Mesh prim; `colors` has one row, or one for each vertex."""
    prim = UsdGeom.Mesh.Define(stage, path)
    prim.CreatePointsAttr(_vec3f(vertices_m))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.reshape(-1).astype(np.int32)))
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreateExtentAttr(_vec3f(np.stack([vertices_m.min(0), vertices_m.max(0)])))
    prim.CreateDoubleSidedAttr(True)
    interpolation = UsdGeom.Tokens.constant if len(colors) == 1 else UsdGeom.Tokens.vertex
    prim.CreateDisplayColorPrimvar(interpolation).Set(_vec3f(colors))
    UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)
    return prim


def _define_object(
    stage: Usd.Stage, placed: PlacedObject, material: UsdShade.Material, time_s: np.ndarray | None
) -> None:
    """An object where it is; along its path where it is moved and the times of the clip's frames are given."""
    if len(placed.mesh.faces) == 0:
        return
    mesh = with_vertex_colors(placed.mesh, placed.textures)
    node = _define_mesh(stage, f"/World/objects/{object_name(placed)}", mesh, material)
    scaling = np.diag([placed.scale, placed.scale, placed.scale, 1.0])
    transform = node.AddTransformOp()
    transform.Set(_matrix(np.asarray(placed.T_world_object) @ scaling))
    if placed.path and time_s is not None:
        poses = np.asarray(placed.path[0].T_world_object)
        for key in needed_keys(poses):
            transform.Set(_matrix(poses[key] @ scaling), Usd.TimeCode(float(time_s[key]) * FPS))
    node.GetPrim().SetCustomDataByKey("label", placed.label)
    node.GetPrim().SetCustomDataByKey("trusted", bool(placed.trusted))


def _define_character(stage: Usd.Stage, character: Character, material: UsdShade.Material) -> None:
    motion = character.motion
    name = f"person_{motion.person_id}"
    root = UsdSkel.Root.Define(stage, f"/World/{name}")
    joints_m = motion.joints_world_m.reshape(-1, 3)
    root.CreateExtentAttr(_vec3f(np.stack([joints_m.min(0) - _BODY_REACH_M, joints_m.max(0) + _BODY_REACH_M])))
    root.GetPrim().SetCustomDataByKey("framesWithoutMeasurement", _ints(np.flatnonzero(~motion.valid)))
    paths = _joint_paths()
    skeleton = UsdSkel.Skeleton.Define(stage, f"{root.GetPath()}/{name}_skeleton")
    skeleton.CreateJointsAttr(paths)
    rig = character.rig()
    skeleton.CreateBindTransformsAttr(Vt.Matrix4dArray([_matrix(np.linalg.inv(m)) for m in rig.inverse_bind]))
    rest = np.tile(np.eye(4), (len(paths), 1, 1))
    rest[:, :3, :3], rest[:, :3, 3] = matrix_from_quaternion(rig.rest_wxyz), rig.offsets_m
    skeleton.CreateRestTransformsAttr(Vt.Matrix4dArray([_matrix(m) for m in rest]))
    animation = _define_animation(stage, f"{skeleton.GetPath()}/animation", character, rig, paths)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation])
    skin = linear_from_srgb(np.array([SKIN_RGB]))
    path = f"{root.GetPath()}/{name}_body"
    mesh = _define_triangles(stage, path, character.vertices_m, character.faces, skin, material)
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1.0))
    weights = character.joint_weight.reshape(-1).astype(np.float32)
    binding.CreateJointIndicesPrimvar(False, INFLUENCES).Set(_ints(character.joint_index.reshape(-1)))
    binding.CreateJointWeightsPrimvar(False, INFLUENCES).Set(Vt.FloatArray.FromNumpy(weights))


def _define_animation(stage: Usd.Stage, path: str, character: Character, rig: Rig, joint_paths: list[str]) -> Sdf.Path:
    animation = UsdSkel.Animation.Define(stage, path)
    animation.CreateJointsAttr(joint_paths)
    animation.CreateScalesAttr(Vt.Vec3hArray([Gf.Vec3h(1.0)] * len(joint_paths)))
    translations, rotations = animation.CreateTranslationsAttr(), animation.CreateRotationsAttr()
    offsets_m = rig.offsets_m.copy()
    for frame, time_s in enumerate(character.motion.frame_time_s):
        code = Usd.TimeCode(float(time_s) * FPS)
        offsets_m[0] = character.root_translation_m[frame]
        translations.Set(_vec3f(offsets_m), code)
        rotations.Set(Vt.QuatfArray([Gf.Quatf(*q) for q in rig.rotations_wxyz[frame].tolist()]), code)
    return animation.GetPath()


def _define_camera(stage: Usd.Stage, motion: BodyMotion) -> None:
    lens = motion.intrinsics
    camera = UsdGeom.Camera.Define(stage, "/World/camera")
    camera.CreateHorizontalApertureAttr(_APERTURE)
    camera.CreateFocalLengthAttr(_APERTURE * lens.fx_px / lens.width_px)
    camera.CreateVerticalApertureAttr(_APERTURE * lens.fx_px / lens.width_px * lens.height_px / lens.fy_px)
    camera.CreateClippingRangeAttr(Gf.Vec2f(NEAR_M, FAR_M))
    transform = camera.AddTransformOp()
    poses = opengl_camera_poses(motion.T_world_camera)
    if is_still(poses):
        transform.Set(_matrix(poses[0]))
        return
    for time_s, pose in zip(motion.frame_time_s, poses, strict=True):
        transform.Set(_matrix(pose), Usd.TimeCode(float(time_s) * FPS))


def _vertex_color_material(stage: Usd.Stage) -> UsdShade.Material:
    """Matte surface that shows `displayColor`."""
    material = UsdShade.Material.Define(stage, "/World/materials/vertex_color")
    reader = UsdShade.Shader.Define(stage, f"{material.GetPath()}/color")
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
    surface = UsdShade.Shader.Define(stage, f"{material.GetPath()}/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.7)
    color = surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    color.ConnectToSource(reader.CreateOutput("result", Sdf.ValueTypeNames.Float3))
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    return material


def _joint_paths() -> list[str]:
    paths: list[str] = []
    for joint, name in enumerate(JOINT_NAMES):
        paths.append(name if PARENTS[joint] < 0 else f"{paths[PARENTS[joint]]}/{name}")
    return paths


def _vec3f(rows: np.ndarray) -> Vt.Vec3fArray:
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(rows, np.float32))


def _ints(values: np.ndarray) -> Vt.IntArray:
    return Vt.IntArray.FromNumpy(np.ascontiguousarray(values, np.int32))


def _matrix(T: np.ndarray) -> Gf.Matrix4d:
    """USD multiplies row vectors from the left, so its matrices are transposed."""
    return Gf.Matrix4d(np.asarray(T, np.float64).T.tolist())
