"""Refinement (paper 8.2): keep sparse keyframes, let an in-betweening prior make the frames between them.

The prior is `scenemi`, or interpolation where its weights are absent. A window that the prior makes worse than
what was observed is filled again from all optimized keyframes and, failing that, is the observed motion without its
jitter; either is reported.
Then the root is settled (standing feet stand, skin comes out of solids) and feet are held in their contact phases.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from jaxtyping import Bool, Float

from video2anim.errors import UsageError
from video2anim.pipeline.options import limits, only_with
from video2anim.pipeline.stage import StageContext, StageSpec
from video2anim.types import BodyMotion, KeyframedMotion, RefinedMotion, SceneModel

if TYPE_CHECKING:
    from scenemi.foot_lock import FootLock
    from scenemi.longmotion import LongMotion
    from scenemi.prior import InbetweeningPrior, WindowMotion
    from scenemi.settle_root import Sight
    from scenemi.windows import WindowSpan
    from video2anim.body.anny_body import ShapedBody
    from video2anim.geometry.sdf import SdfGrid

FPS = 30.0
"""Motion is at 30 fps after ingest."""
_JUMP = 6.0
"""Frames whose jerk exceeds the median by this factor are jumps of the observation."""

_OBSERVED = 2
"""Density of a window that keeps the observed motion: its every frame is an exact keyframe."""
_JOINED_FRAMES = 3
"""So many first frames of a window keep the shift of the window before: speed goes on with it."""
_SETTLING_ACCELERATIONS_M_S2 = (2.0, 0.5, 0.12)
"""How fast the settling shift may change: the first that does not shake the body, else the last. Feet on a treadmill
and bodies that are deep in wrong solids would have it thrown about."""


@dataclass(frozen=True)
class RefineConfig:
    """Which prior, how sparse its keyframes, and when its result is not taken."""

    prior: Literal["auto", "interpolation", "scenemi"] = "auto"
    """`auto` = `scenemi` where weights are present, else `interpolation`."""
    keyframe_interval_frames: Annotated[int, limits("frames", ge=1, le=100_000)] = 15
    """Frames between keyframes given to the prior (paper: every third optimized keyframe)."""
    keyframe_noise_level: Annotated[float, limits(ge=0, le=100)] = 1.0
    """How far keyframes from video are off, in degrees and centimetres (paper's l); 0 = they are met exactly."""
    window_frames: Annotated[int, limits("frames", ge=2, le=100_000)] = 121
    """Length of one synthesis (paper: N = 121)."""
    overlap_frames: Annotated[int, limits("frames", ge=0, le=100_000)] = 60
    """Frames of a window that seed the next (paper: v = 60)."""
    low_pass_hz: Annotated[float, limits("Hz", ge=0, lt=0.5 * FPS)] = 6.0
    """Cutoff of the filter that takes the jitter out of the observed motion before keyframes are read from it
    (6 Hz is usual in gait analysis); 0 = no filter."""
    fallback: bool = True
    """Fill a window with denser keyframes where the prior makes it worse."""
    penetration_slack_m: Annotated[float, limits("m", ge=0, le=100), only_with("fallback", True)] = 0.01
    """A window is worse when its deepest vertex is deeper than before by more than this."""
    skating_slack: Annotated[float, limits(ge=0, le=10), only_with("fallback", True)] = 0.05
    """A window is worse when its skating ratio (gmd) rises by more than this."""
    jerk_slack: Annotated[float, limits(ge=0, le=1000)] = 0.1
    """A window is worse when its jerk rises by more than this share."""
    deviation_limit_m: Annotated[float, limits("m", gt=0, le=100), only_with("fallback", True)] = 0.05
    """A window is worse when joints lie on average farther than this from the observed frames: the prior has lost a
    motion that is faster than the keyframes."""
    settle: bool = True
    """Move the root by centimetres where standing feet slide or skin is inside solids."""
    picture_limit_ratio: Annotated[float, limits(ge=0, le=100), only_with("settle", True)] = 0.03
    """Farthest that settling moves the root across the line of sight, as a share of the stature."""
    foot_lock: bool = True
    """Hold feet still in contact phases, and swinging toes off the floor."""
    sampled_vertices: Annotated[int, limits(ge=1, le=100_000)] = 500
    """Skin vertices that penetration is measured with."""

    def __post_init__(self) -> None:
        if self.overlap_frames >= self.window_frames:
            raise UsageError(
                f"refine: want overlap_frames < window_frames, got {self.overlap_frames} and {self.window_frames}"
            )


def refine_motion(
    keyframed: KeyframedMotion, scene: SceneModel, config: RefineConfig, ctx: StageContext
) -> RefinedMotion:
    """Make the final motion of every person.

    Raises:
        ModelMissingError: the prior is set to `scenemi` and its weights are absent.
    """
    from scenemi.prior import load_prior
    from video2anim.geometry.sdf import SdfGrid

    prior = load_prior(config.prior, device=ctx.device, seed=ctx.seed)
    if config.prior == "auto" and prior.name != "scenemi":
        ctx.warn("no scenemi weights present, keyframes are joined by interpolation")
    grid = SdfGrid(scene.sdf_m, scene.sdf_origin_m, scene.sdf_spacing_m)
    people, names, shares = [], [], []
    for number, (motion, index) in enumerate(zip(keyframed.people, keyframed.keyframe_index, strict=True)):
        suffix = "" if number == 0 else f" (person {motion.person_id})"
        if len(index) == 0 or not motion.valid.any():
            ctx.warn(f"person {motion.person_id} has no keyframe, motion left as it is")
            people.append(motion)
            names.append("none")
            shares.append(0.0)
            continue
        refined, share = _refine_person(motion, index, prior, grid, config, ctx, suffix)
        people.append(refined)
        names.append(prior.name if share > 0 else "none")
        shares.append(share)
        ctx.progress(number + 1, len(keyframed.people))
    return RefinedMotion(tuple(people), tuple(names), tuple(shares))


def _refine_person(
    motion: BodyMotion,
    optimized: np.ndarray,
    prior: InbetweeningPrior,
    grid: SdfGrid,
    config: RefineConfig,
    ctx: StageContext,
    suffix: str,
) -> tuple[BodyMotion, float]:
    """The motion, and the share of its measured frames that the prior shaped."""
    from scenemi.longmotion import KeyframeMotion, inbetween
    from scenemi.prior import InterpolationPrior
    from scenemi.windows import select_keyframes

    calm = calm_frames(motion)
    keys = select_keyframes(motion.frame_count, config.keyframe_interval_frames, usable=calm)
    judge = _Judge(motion, calm, grid, config)
    R_parent_joint, translation_m = _without_jitter(motion, config)
    noise = config.keyframe_noise_level
    # The last resort is the observed motion itself, so there its frames count as exact.
    given, at_optimized, at_all = (
        KeyframeMotion(R_parent_joint, translation_m, mask, motion.rest_joints_m, FPS, judge.body, level)
        for mask, level in (
            (_mask(keys, motion), noise),
            (_mask(optimized, motion) & calm, noise),
            (motion.valid, 0.0),
        )
    )
    window, overlap = config.window_frames, config.overlap_frames
    plain = inbetween(given, InterpolationPrior(), window=window, overlap=overlap)
    denser = (at_optimized, at_all) if config.fallback else ()
    filled = inbetween(
        given, prior, scene=grid, denser=denser, accept=judge.accept, taken=judge.settle, window=window, overlap=overlap
    )
    settled_m = filled.translation_world_m + judge.shift_m
    unlocked = motion.with_pose(translation_world_m=settled_m, R_parent_joint=filled.R_parent_joint)
    final = judge.with_held_feet(ctx, unlocked, suffix) if config.foot_lock else unlocked
    judge.report(ctx, "raw", motion, suffix)
    judge.report(
        ctx,
        f"interpolation every {config.keyframe_interval_frames}",
        motion.with_pose(translation_world_m=plain.translation_world_m, R_parent_joint=plain.R_parent_joint),
        suffix,
    )
    if config.foot_lock:
        judge.report(ctx, "without foot lock", unlocked, suffix)
    judge.report(ctx, "refined", final, suffix)
    _report_windows(ctx, filled, prior, suffix)
    share = float(_shaped(filled, motion.frame_count)[motion.valid].mean())
    ctx.quality(f"frames shaped by {prior.name}{suffix}", share, "ratio", "higher")
    return final, share


def calm_frames(motion: BodyMotion) -> Bool[np.ndarray, "frames"]:
    """Valid frames in which the observed body does not jump: where the landmark model changes its mind about left and
    right, or front and back, the jerk is many times what it is elsewhere, and poses tell nothing."""
    calm = motion.valid.copy()
    jerk_m_s3 = np.linalg.norm(np.diff(motion.joints_world_m, n=3, axis=0), axis=-1).mean(1) * FPS**3
    if not len(jerk_m_s3):
        return calm
    for first in np.flatnonzero(jerk_m_s3 > _JUMP * np.median(jerk_m_s3)):
        calm[first : first + 4] = False
    # Somebody who jumps about all the time is taken as observed.
    return calm if calm.sum() > 0.5 * motion.valid.sum() else motion.valid


def _without_jitter(motion: BodyMotion, config: RefineConfig) -> tuple[np.ndarray, np.ndarray]:
    from video2anim.geometry.smoothing import low_pass

    translation_m = motion.T_world_root[:, :3, 3]
    if config.low_pass_hz == 0:
        return motion.R_parent_joint, translation_m
    return low_pass(motion.R_parent_joint, translation_m, motion.valid, fps=FPS, cutoff_hz=config.low_pass_hz)


def _mask(index: np.ndarray, motion: BodyMotion) -> Bool[np.ndarray, "frames"]:
    mask = np.zeros(motion.frame_count, dtype=bool)
    mask[index] = True
    return mask


def _shaped(filled: LongMotion, frames: int) -> Bool[np.ndarray, "frames"]:
    """Frames whose last window was filled from sparse keyframes and not from all of the observed frames."""
    shaped = np.zeros(frames, dtype=bool)
    for span, density in zip(filled.spans, filled.densities, strict=True):
        shaped[span.start : span.stop] = density < _OBSERVED
    return shaped


def _report_windows(ctx: StageContext, filled: LongMotion, prior: InbetweeningPrior, suffix: str) -> None:
    fallen = sum(density > 0 for density in filled.densities)
    observed = sum(density == _OBSERVED for density in filled.densities)
    ctx.quality(f"windows with denser keyframes{suffix}", fallen / len(filled.densities), "ratio", "lower")
    if fallen:
        ctx.warn(
            f"{prior.name} made {fallen} of {len(filled.densities)} windows worse than the observed motion; "
            f"{fallen - observed} are filled from all optimized keyframes, {observed} keep the smoothed observation"
            f"{suffix}"
        )
    if len(filled.bridged_index):
        frames = ", ".join(str(i) for i in filled.bridged_index)
        ctx.warn(f"gaps longer than a window were bridged by interpolation at frames {frames}{suffix}")


class _Judge:
    """Measures motions of one person against the scene and the observed motion."""

    def __init__(self, motion: BodyMotion, calm: np.ndarray, grid: SdfGrid, config: RefineConfig) -> None:
        from video2anim.body.anny_body import shaped_body

        self.observed, self.calm, self.grid, self.config = motion, calm, grid, config
        self.body: ShapedBody = shaped_body(motion.shape)
        stride = max(1, len(self.body.rest_vertices_m) // config.sampled_vertices)
        self.vertex_index = np.arange(0, len(self.body.rest_vertices_m), stride)
        self.contact = np.where(motion.valid[:, None], motion.contact, 0.0)
        measured = np.flatnonzero(motion.valid)
        self.span = slice(int(measured[0]), int(measured[-1]) + 1)
        self.shift_m = np.zeros((motion.frame_count, 3))
        self._settled_from: int | None = None
        self.observed_distance_m = self._distance_m(motion.R_parent_joint, motion.T_world_root[:, :3, 3])

    def accept(self, span: WindowSpan, filled: WindowMotion) -> bool:
        """Whether a filled window, settled and with feet held, is no worse than the observed one."""
        from scenemi.metrics import foot_skating_gmd, jerk_m_s3, penetration_max_m

        frames = slice(span.start, span.stop)
        R_parent_joint = filled.R_parent_joint
        translation_m = filled.translation_world_m + self._settling_shift(span, filled)
        if self.config.foot_lock:
            R_parent_joint, _ = self._held(R_parent_joint, translation_m, frames)
        joints_m = self._joints_m(R_parent_joint, translation_m)
        before_m = self.observed.joints_world_m[frames]
        deviation_m = np.linalg.norm(joints_m - before_m, axis=-1)[self.calm[frames]]
        if deviation_m.size and deviation_m.mean() > self.config.deviation_limit_m:
            return False
        if len(joints_m) > 1:
            skating, skating_before = foot_skating_gmd(joints_m, FPS), foot_skating_gmd(before_m, FPS)
            if skating > skating_before + self.config.skating_slack:
                return False
        if len(joints_m) > 3 and jerk_m_s3(joints_m, FPS) > (1 + self.config.jerk_slack) * jerk_m_s3(before_m, FPS):
            return False
        depth_m = penetration_max_m(self._distance_m(R_parent_joint, translation_m))
        return depth_m <= penetration_max_m(self.observed_distance_m[frames]) + self.config.penetration_slack_m

    def settle(self, span: WindowSpan, filled: WindowMotion) -> None:
        """Go on with the shift that puts standing feet to rest and takes skin out of solids. Frames before a window
        keep theirs, so that an edit changes nothing before its windows."""
        self.shift_m[span.start : span.stop] = self._settling_shift(span, filled)
        self.shift_m[span.stop :] = self.shift_m[span.stop - 1]
        if self._settled_from is None:
            self._settled_from = span.start
            self.shift_m[: span.start] = self.shift_m[span.start]

    def _settling_shift(self, span: WindowSpan, filled: WindowMotion) -> Float[np.ndarray, "frames 3"]:
        from scenemi.settle_root import SettleConfig, SkinNearSolids, settling_shift
        from video2anim.body.skeleton import forward_kinematics

        frames = slice(span.start, span.stop)
        if not self.config.settle:
            return self.shift_m[frames]
        joints_m, R_world_joint = forward_kinematics(
            filled.R_parent_joint, filled.translation_world_m, self.observed.rest_joints_m
        )
        skin = SkinNearSolids(self.body.vertices(R_world_joint, joints_m, self.vertex_index), self.grid)
        begun_m = None if self._settled_from is None else self.shift_m[span.start : span.start + _JOINED_FRAMES]
        *stiffening, stiffest = [SettleConfig(acceleration_m_s2=most) for most in _SETTLING_ACCELERATIONS_M_S2]
        seen = self._sight(frames)
        solve = partial(settling_shift, joints_m, self.contact[frames], FPS, skin=skin, sight=seen, begun_m=begun_m)
        for config in stiffening:
            shift_m = solve(config=config)
            if self._is_calm(joints_m + shift_m[:, None], joints_m, frames):
                return shift_m
        return solve(config=stiffest)

    def _sight(self, frames: slice) -> Sight:
        """Lines of sight to the observed roots."""
        from scenemi.settle_root import Sight
        from video2anim.fitting.keyframe_sight import sight_of

        seen = sight_of(
            self.observed, np.arange(frames.start, frames.stop),
            stature_m=float(np.ptp(self.body.rest_vertices_m[:, 1])),
            limit_ratio=self.config.picture_limit_ratio, reprojection_px=0.0,
        )  # fmt: skip
        return Sight(seen.direction, seen.limit_m)

    def _is_calm(self, joints_m: np.ndarray, before_m: np.ndarray, frames: slice) -> bool:
        """Whether a motion's jerk is hardly above that of the motion before and of the observed one."""
        from scenemi.metrics import jerk_m_s3

        if len(joints_m) < 4:
            return True
        usual_m_s3 = max(jerk_m_s3(before_m, FPS), jerk_m_s3(self.observed.joints_world_m[frames], FPS))
        return jerk_m_s3(joints_m, FPS) <= (1 + self.config.jerk_slack) * usual_m_s3

    def with_held_feet(self, ctx: StageContext, motion: BodyMotion, suffix: str) -> BodyMotion:
        """The motion with its feet held in the observed contact phases, and how many of those contradict it."""
        translation_m = motion.T_world_root[:, :3, 3]
        R_parent_joint, locked = self._held(motion.R_parent_joint, translation_m, slice(0, motion.frame_count))
        ctx.quality(f"foot phases held{suffix}", locked.held_phases, "count")
        ctx.quality(f"foot phases left free{suffix}", locked.refused_phases, "count", "lower")
        return motion.with_pose(translation_world_m=translation_m, R_parent_joint=R_parent_joint)

    def report(self, ctx: StageContext, when: str, motion: BodyMotion, suffix: str) -> None:
        """Quality from the first to the last valid frame."""
        from scenemi import metrics

        joints_m = motion.joints_world_m[self.span]
        distance_m = self._distance_m(motion.R_parent_joint[self.span], motion.T_world_root[self.span, :3, 3])
        for name, value, unit in (
            ("jerk", metrics.jerk_m_s3(joints_m, FPS), "m/s^3"),
            ("foot skating gmd", metrics.foot_skating_gmd(joints_m, FPS), "ratio"),
            ("penetration max", metrics.penetration_max_m(distance_m), "m"),
            ("collision frames 1 cm", metrics.collision_frame_ratio(distance_m, metrics.COLLISION_TAUS_M[1]), "ratio"),
        ):
            ctx.quality(f"{name} {when}{suffix}", value, unit, "lower")

    def _held(
        self, R_parent_joint: np.ndarray, translation_m: np.ndarray, frames: slice
    ) -> tuple[Float[np.ndarray, "frames 22 3 3"], FootLock]:
        """Local rotations with feet held and swings cleared, and what the lock says of its phases."""
        from scenemi.foot_lock import lock_feet
        from scenemi.swing_clearance import clear_swings

        rest_m = self.observed.rest_joints_m
        # Where the settled motion has its feet, not the observed one: the root has moved.
        reference_m = None if self.config.settle else self.observed.joints_world_m[frames]
        locked = lock_feet(R_parent_joint, translation_m, rest_m, self.contact[frames], FPS, reference_m)
        return clear_swings(locked.R_parent_joint, translation_m, rest_m, self.contact[frames], FPS), locked

    def _joints_m(self, R_parent_joint: np.ndarray, translation_m: np.ndarray) -> Float[np.ndarray, "frames 22 3"]:
        from video2anim.body.skeleton import forward_kinematics

        return forward_kinematics(R_parent_joint, translation_m, self.observed.rest_joints_m)[0]

    def _distance_m(self, R_parent_joint: np.ndarray, translation_m: np.ndarray) -> Float[np.ndarray, "frames skin"]:
        """Signed distance of the sampled skin to the scene."""
        from video2anim.body.skeleton import forward_kinematics

        joints_m, R_world_joint = forward_kinematics(R_parent_joint, translation_m, self.observed.rest_joints_m)
        return self.grid.sample(self.body.vertices(R_world_joint, joints_m, self.vertex_index).astype(np.float64))


STAGE = StageSpec("refine", refine_motion, version=7, models=("prior",))
