"""What others build on. A change here is a change for them: note it in the changelog."""

from __future__ import annotations

import inspect
from typing import Any

import typer

import scenemi
from video2anim import errors, export, networks, types, viewer
from video2anim.cli.compose import pipeline_nodes
from video2anim.cli.main import app
from video2anim.types import BodyMotion

TYPES = [
    "BackgroundImage",
    "BackgroundPoints",
    "BodyMotion",
    "BodyShape",
    "BodyTracks",
    "CameraEstimate",
    "CompletedObject",
    "CompletedObjects",
    "Contact",
    "DepthClip",
    "ExportedFiles",
    "Hold",
    "InstanceMasks",
    "Intrinsics",
    "KeyframedMotion",
    "Mesh",
    "MetricDepth",
    "ObjectInstance",
    "ObjectMesh",
    "ObjectMeshes",
    "ObjectPart",
    "ObjectPath",
    "PayloadFile",
    "PersonQuality",
    "PersonTrack",
    "PersonTracks",
    "PlacedObject",
    "PlacedObjects",
    "RefinedMotion",
    "RoomPiece",
    "SceneModel",
    "SourceInfo",
    "SourceVideo",
    "Storage",
    "Texture",
    "Thumbnail",
    "VideoClip",
    "View",
    "stored",
]
COMMANDS = {
    "": {"--version", "--debug"},
    "run": {
        "VIDEO", "--out", "--preset", "--set", "--from", "--until", "--person", "--focal-px", "--height-m", "--device",
        "--overwrite", "--keep-edits", "--discard-edits", "--yes",
    },
    "stage": {"DIR", "STAGE", "--keep-edits", "--discard-edits", "--device"},
    "status": {"DIR"},
    "show": {"DIR", "STAGE"},
    "export": {"DIR", "--format", "--out", "--body", "--smpl-dir"},
    "view": {"DIR", "--screenshot", "--frame", "--motion", "--body", "--smpl-dir"},
    "demo": {"--out", "--device"},
    "synth": {
        "--out", "--preset", "--count", "--seed", "--workers", "--size", "--motion", "--noncommercial",
        "--no-noncommercial", "--meshes", "--room-size", "--longest", "--frames-only", "--no-frames-only",
        "--motion-only", "--no-motion-only",
    },
    "eval": {"DIR", "--truth", "--json", "--html"},
    "eval-set": {"RESULTS_DIR", "--truth", "--workers", "--json", "--html"},
    "models list": set(),
    "models run": {"SLOT", "IMAGE...", "--out", "--model"},
    "models pull": {"NAME"},
    "models verify": set(),
}  # fmt: skip
STAGES = [
    ("ingest", "VideoClip"),
    ("track", "PersonTracks"),
    ("camera", "CameraEstimate"),
    ("humans", "BodyTracks"),
    ("background", "BackgroundImage"),
    ("depth", "DepthClip"),
    ("segment", "InstanceMasks"),
    ("metric", "MetricDepth"),
    ("complete", "CompletedObjects"),
    ("reconstruct", "ObjectMeshes"),
    ("place", "PlacedObjects"),
    ("scene", "SceneModel"),
    ("keyframes", "KeyframedMotion"),
    ("refine", "RefinedMotion"),
    ("export", "ExportedFiles"),
]


def commands() -> dict[str, set[str]]:
    """Every command with its options and arguments, as the parser knows them."""
    found: dict[str, set[str]] = {}

    def visit(command: Any, name: str) -> None:
        words = set()
        for parameter in command.params:
            if parameter.param_type_name == "argument":
                words.add((parameter.metavar or parameter.name).upper())
            elif parameter.name != "help":
                words |= {*parameter.opts, *parameter.secondary_opts}
        if not getattr(command, "commands", None) or words:
            found[name] = words
        for child, inner in getattr(command, "commands", {}).items():
            visit(inner, f"{name} {child}".strip())

    visit(typer.main.get_command(app), "")
    return found


def test_types() -> None:
    assert list(types.__all__) == TYPES == sorted(TYPES, key=lambda name: (name == "stored", name))
    assert all(getattr(types, name) is not None for name in TYPES)


def test_motion_fields() -> None:
    assert list(BodyMotion.__dataclass_fields__) == [
        "person_id", "frame_time_s", "valid", "T_world_root", "R_parent_joint", "T_world_camera", "intrinsics",
        "contact", "shape", "rest_joints_m", "joints_world_m",
    ]  # fmt: skip


def test_commands_and_options() -> None:
    assert commands() == COMMANDS


def test_every_option_is_explained() -> None:
    def visit(command: Any) -> None:
        for parameter in command.params:
            assert parameter.name == "help" or getattr(parameter, "help", None), (command.name, parameter.name)
        for inner in getattr(command, "commands", {}).values():
            assert inner.help
            visit(inner)

    visit(typer.main.get_command(app))


def test_stages_in_order() -> None:
    assert [(node.name, node.output.__name__) for node in pipeline_nodes()] == STAGES


def test_every_stage_option_is_explained() -> None:
    """A docstring follows each field of each stage's config."""
    for node in pipeline_nodes():
        source = inspect.getsource(node.config_type)
        fields = node.config_type.__dataclass_fields__
        assert node.config_type.__dataclass_params__.frozen
        assert source.count('"""') >= 2 * (len(fields) + 1), f"{node.config_type.__name__} has unexplained options"


def test_exit_codes() -> None:
    codes = {name: kind.exit_code for name, kind in vars(errors).items() if hasattr(kind, "exit_code")}
    assert codes == {
        "Video2AnimError": 5, "UsageError": 2, "InputError": 3, "ModelMissingError": 4, "StageError": 5,
        "ArtifactError": 5,
    }  # fmt: skip


def test_packages() -> None:
    assert {"KeyframeMotion", "inbetween", "load_prior", "InbetweeningPrior"} <= set(scenemi.__all__)
    assert set(export.FORMATS) == {"glb", "usd", "bvh", "amass", "fbx", "fbx-ready"}
    assert {"find_model", "load_model", "pull", "verify"} <= set(networks.__all__)
    assert viewer.__all__ == ["SceneView", "screenshot", "view"]
