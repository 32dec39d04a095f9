"""Scene-aware motion in-betweening: fill the frames between keyframes of a body in a scene (SceneMI, ICCV 2025).

from scenemi import KeyframeMotion, inbetween, load_prior

filled = inbetween(KeyframeMotion(R_parent_joint, translation_m, is_keyframe, rest_joints_m), load_prior("auto"))
"""

from scenemi.longmotion import KeyframeMotion, LongMotion, inbetween
from scenemi.model.load import load_prior, scenemi_available
from scenemi.postprocess.motion_solve import SceneMotion, solve_motions
from scenemi.postprocess.solids import Solids
from scenemi.prior import (
    InbetweeningPrior,
    InterpolationPrior,
    KeyframeWindow,
    WindowMotion,
)
from scenemi.windows import OVERLAP_FRAMES, WINDOW_FRAMES, plan_windows, select_keyframes

__all__ = [
    "OVERLAP_FRAMES",
    "WINDOW_FRAMES",
    "InbetweeningPrior",
    "InterpolationPrior",
    "KeyframeMotion",
    "KeyframeWindow",
    "LongMotion",
    "SceneMotion",
    "Solids",
    "WindowMotion",
    "inbetween",
    "load_prior",
    "plan_windows",
    "scenemi_available",
    "select_keyframes",
    "solve_motions",
]
