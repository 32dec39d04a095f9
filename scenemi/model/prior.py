"""The diffusion model as an in-betweening prior: world-frame windows in, world-frame motion out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from scenemi.features import canonical_frame, decode, encode, to_world
from scenemi.model.cleanup import Cleanup, penetration_cost
from scenemi.model.denoiser import TRAINED_NOISE, Conditions
from scenemi.model.diffusion import CosineSchedule
from scenemi.model.guidance import ContactCost, Cost, Guidance, KeyframeCost, PenetrationCost
from scenemi.model.keyframe_fit import fit_keyframes
from scenemi.model.kinematics import joints_of, pose_of
from scenemi.model.sampling import Denoise, SamplerConfig, sample
from scenemi.model.scene_input import SceneInput, SceneReader, adult_like
from scenemi.model.weights import LoadedModel, load_weights
from scenemi.prior import KeyframeWindow, WindowMotion, padded
from video2anim.errors import InputError, UsageError
from video2anim.geometry.rotations import nearest_rotation

BATCH_WINDOWS = 32
"""Windows sampled at once by `fill_many`: more take memory and no less time."""
MODEL_FPS = 30.0
Runtime = Literal["torch", "onnx"]
"""onnxruntime needs 0.7 of torch's time on a CPU, but a second and the package `onnx` for the export, which pays after
some ten windows (benchmarks/denoiser_runtime.py): torch is the default."""


class DiffusionPrior:
    """Fills windows by sampling the denoiser. A window of which every frame is an exact keyframe is left as it is."""

    name = "scenemi"

    def __init__(
        self,
        model: LoadedModel,
        sampler: SamplerConfig | None = None,
        *,
        device: str = "cpu",
        runtime: Runtime = "torch",
        seed: int = 0,
    ) -> None:
        """`seed` is that of `fill`; `fill_many` takes one per window."""
        self.model, self.sampler, self.device = model, sampler or SamplerConfig(), device
        self.runtime, self.seed = runtime, seed
        self.schedule = CosineSchedule()
        self._denoiser = model.denoiser.to(device).eval()
        self._denoise: Denoise = self._denoiser if runtime == "torch" else _onnx(model, device)
        self._scenes = SceneReader()

    def fill(self, window: KeyframeWindow) -> WindowMotion:
        """Motion of every frame. Exact keyframes and seed frames are met to 1e-6; noisy keyframes are cleaned.

        Raises:
            InputError: a window longer than the model's, or another frame rate.
        """
        return self.fill_many([window], [self.seed])[0]

    def fill_many(self, windows: Sequence[KeyframeWindow], seeds: Sequence[int]) -> list[WindowMotion]:
        """Several windows at once; a window's motion depends on its own seed only (to rounding, which the repairs after
        sampling may make as large as a millimetre).

        Raises:
            InputError: a window longer than the model's, or another frame rate.
        """
        for window in windows:
            _expect_fit(window, self.model.config.window_frames)
        filled: list[WindowMotion | None] = [None] * len(windows)
        todo = []
        for i, window in enumerate(windows):
            if window.noise_level == 0 and window.is_keyframe.all():
                filled[i] = WindowMotion(window.R_parent_joint.copy(), window.translation_world_m.copy())
            else:
                todo.append(i)
        for noisy in (False, True):
            alike = [i for i in todo if (windows[i].noise_level > 0) == noisy]
            for start in range(0, len(alike), BATCH_WINDOWS):
                some = alike[start : start + BATCH_WINDOWS]
                motions = self._fill_batch([windows[i] for i in some], [seeds[i] for i in some], noisy)
                for i, motion in zip(some, motions, strict=True):
                    filled[i] = motion
        return [motion for motion in filled if motion is not None]

    def _fill_batch(self, windows: list[KeyframeWindow], seeds: list[int], noisy: bool) -> list[WindowMotion]:
        longer = [padded(window, self.model.config.window_frames) for window in windows]
        frames = np.stack([_canonical(window) for window in longer])
        x_keys, conditions = self._conditions(longer, frames)
        stop_step = self.sampler.stop_for(noisy)
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        rest_joints_m = self._tensor(np.stack([window.rest_joints_m for window in longer]))
        penetration = self._penetration(longer, frames, rest_joints_m, conditions)
        guidance = self._guidance(rest_joints_m, x_keys, conditions, penetration)
        x0 = sample(
            self._denoise, self.schedule, x_keys, conditions, self.sampler, generators,
            stop_step=stop_step, adjust=guidance,
        )  # fmt: skip
        rounds = {"foot_rounds": self.sampler.foot_rounds, "clear_rounds": self.sampler.clear_rounds}
        x0 = Cleanup(self.model.statistics, rest_joints_m, MODEL_FPS, **rounds, clearing=penetration)(x0)
        features = self.model.statistics.denormalize(x0.cpu().double())
        local, moved = decode(features.numpy())
        R_parent_joint, translation_m = to_world(local, moved, frames)
        results = []
        for window, rotations, positions in zip(windows, R_parent_joint, translation_m, strict=True):
            count = len(window.is_keyframe)
            made = WindowMotion(nearest_rotation(rotations[:count]), positions[:count])
            results.append(fit_keyframes(made, _given(window), self._exact(window)))
        return results

    def _exact(self, window: KeyframeWindow) -> Bool[np.ndarray, "frames"]:
        """Frames that are met: the seed, and all keyframes where they carry no noise."""
        exact = np.arange(len(window.is_keyframe)) < window.seed_frames
        if window.noise_level == 0 and self.sampler.hard_keyframes:
            exact |= window.is_keyframe
        return exact

    def _conditions(
        self, windows: list[KeyframeWindow], T_world_canonical: Float[np.ndarray, "batch 4 4"]
    ) -> tuple[Tensor, Conditions]:
        """Normalized keyframes (zero elsewhere) and what the denoiser is conditioned on."""
        config, statistics = self.model.config, self.model.statistics
        features, inputs = [], []
        for window, T in zip(windows, T_world_canonical, strict=True):
            keys = window.is_keyframe
            values = np.zeros((len(keys), config.feature_count), np.float32)
            motion = window.R_parent_joint[keys], window.translation_world_m[keys]
            values[keys] = statistics.normalize(encode(*motion, window.rest_joints_m, T))
            features.append(values)
            inputs.append(self._scenes.read(window, T, config))
        x_keys = self._tensor(np.stack(features))
        mask = self._tensor(np.stack([window.is_keyframe for window in windows]))
        known = self._tensor(np.array([one.occupancy is not None for one in inputs]))
        body = self._tensor(np.stack([statistics.normalize_body(one.lengths_m) for one in inputs]))
        noise_level = self._tensor(np.array([window.noise_level for window in windows]))
        seed = np.arange(len(windows[0].is_keyframe)) < np.array([[window.seed_frames] for window in windows])
        conditions = Conditions(
            mask=mask,
            imputed=mask,
            base=self._denoiser.join(x_keys, mask, body, noise_level, exact=self._tensor(seed)),
            local=self._tensor(np.stack([one.local_m for one in inputs])),
            body=body,
            noise_level=noise_level.clamp(max=TRAINED_NOISE),
            scene=self._encoded(inputs),
            scene_known=known,
            local_known=known,
        )
        return x_keys, conditions

    def _encoded(self, inputs: list[SceneInput]) -> Tensor:
        """Global scene vectors; one pass per window batch, none where no window has a scene."""
        grids = [one.occupancy for one in inputs]
        if all(grid is None for grid in grids):
            return torch.zeros(len(inputs), self.model.config.embedding, device=self.device)
        empty = np.zeros(self.model.config.grid, bool)
        occupancy = self._tensor(np.stack([empty if grid is None else grid for grid in grids]))
        with torch.no_grad():
            return self._denoiser.encode_scene(occupancy)

    def _penetration(
        self, windows: list[KeyframeWindow], frames: np.ndarray, rest_joints_m: Tensor, conditions: Conditions
    ) -> PenetrationCost | None:
        if not self.sampler.clear_rounds and not self.sampler.penetration_weight:
            return None
        scenes = [window.scene for window in windows]
        bodies = [window.body or adult_like(window.rest_joints_m) for window in windows]
        base = pose_of(self.model.statistics.denormalize(conditions.base), rest_joints_m)
        return penetration_cost(scenes, bodies, self._tensor(frames), base, conditions.mask)

    def _guidance(
        self, rest_joints_m: Tensor, x_keys: Tensor, conditions: Conditions, penetration: PenetrationCost | None
    ) -> Guidance | None:
        sampler = self.sampler
        costs: list[Cost] = []
        if sampler.contact_weight > 0:
            costs.append(ContactCost(MODEL_FPS, sampler.contact_weight))
        if sampler.penetration_weight > 0 and penetration is not None:
            costs.append(replace(penetration, weight=sampler.penetration_weight))
        if sampler.keyframe_weight > 0:
            joints_m = joints_of(self.model.statistics.denormalize(x_keys), rest_joints_m)
            costs.append(KeyframeCost(joints_m, conditions.mask, sampler.keyframe_weight))
        return Guidance(self.model.statistics, rest_joints_m, costs) if costs else None

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.as_tensor(np.asarray(array, np.float32), device=self.device)


def load_diffusion_prior(
    folder: Path,
    *,
    device: str = "cpu",
    weights: str = "small",
    sampler: SamplerConfig | None = None,
    runtime: Runtime = "torch",
    seed: int = 0,
) -> DiffusionPrior:
    """The prior with the weights `<folder>/<weights>.safetensors`, or those of a file path.

    Raises:
        ModelMissingError: no such weights, or no `onnx` package for that runtime.
        InputError: a damaged file.
        UsageError: the runtime `onnx` on another device than the CPU.
    """
    path = Path(weights) if weights.endswith(".safetensors") else folder / f"{weights}.safetensors"
    return DiffusionPrior(load_weights(path), sampler, device=device, runtime=runtime, seed=seed)


def _onnx(model: LoadedModel, device: str) -> Denoise:
    if device != "cpu":
        raise UsageError(f"prior scenemi: the runtime onnx is for the CPU, got device {device!r}; use torch")
    from scenemi.model.onnx_denoiser import OnnxDenoiser

    return OnnxDenoiser(model.denoiser)


def _canonical(window: KeyframeWindow) -> Float[np.ndarray, "4 4"]:
    return canonical_frame(window.R_parent_joint[0, 0], window.translation_world_m[0])


def _given(window: KeyframeWindow) -> WindowMotion:
    return WindowMotion(window.R_parent_joint, window.translation_world_m)


def _expect_fit(window: KeyframeWindow, window_frames: int) -> None:
    if len(window.is_keyframe) > window_frames:
        raise InputError(
            f"prior scenemi: want windows of up to {window_frames} frames, got {len(window.is_keyframe)}; "
            "`scenemi.inbetween` cuts longer motions"
        )
    if abs(window.fps - MODEL_FPS) > 0.01:
        raise InputError(f"prior scenemi: want {MODEL_FPS:g} frames per second, got {window.fps:g}; resample first")
