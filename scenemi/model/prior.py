"""The diffusion model as an in-betweening prior: world-frame windows in, world-frame motion out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.signal import butter, sosfiltfilt
from torch import Tensor

from scenemi.features import FEATURE_COUNT, JOINTS, canonical_frame, decode, encode, to_world
from scenemi.model.base import join_keyframes
from scenemi.model.conditions import Conditions, Descriptors
from scenemi.model.config import PaperConfig
from scenemi.model.denoiser import Denoiser
from scenemi.model.diffusion import CosineSchedule
from scenemi.model.keyframe_fit import fit_keyframes
from scenemi.model.mirror import EvenDenoiser
from scenemi.model.sampling import Denoise, SamplerConfig, sample
from scenemi.model.scene_input import SceneReader, lengths_of
from scenemi.model.weights import LoadedModel, load_weights
from scenemi.prior import KeyframeWindow, WindowMotion, is_exact, padded
from scenemi.scene.field import GridField
from scenemi.scene.grid import canonical_grid
from video2anim.errors import InputError
from video2anim.geometry.rotations import nearest_rotation
from video2anim.types.clip import FPS

BATCH_WINDOWS = 32
"""Windows sampled at once by `fill_many`: more take memory and no less time."""
TRAINED_NOISE = 1.0
"""The largest l in training (paper 3.2.1); noisier keyframes are taken for this noisy."""


class DiffusionPrior:
    """Fills windows by sampling the denoiser. A window of which every frame is an exact keyframe is left as it is."""

    name = "scenemi"

    def __init__(
        self,
        model: LoadedModel,
        sampler: SamplerConfig | None = None,
        *,
        device: str = "cpu",
        seed: int = 0,
    ) -> None:
        """`seed` is that of `fill`; `fill_many` takes one per window."""
        self.model, self.sampler, self.device, self.seed = model, sampler or SamplerConfig(), device, seed
        self.schedule = CosineSchedule()
        denoiser = model.denoiser.to(device).eval()
        self._denoiser: Denoise = EvenDenoiser(denoiser) if isinstance(denoiser, Denoiser) else denoiser
        self._scenes = SceneReader()

    def fill(self, window: KeyframeWindow) -> WindowMotion:
        """Motion of every frame. Exact keyframes and seed frames are met to 1e-6; noisy keyframes are cleaned.

        Raises:
            InputError: a window longer than the model's, or another frame rate.
        """
        return self.fill_many([window], [self.seed])[0]

    def fill_many(self, windows: Sequence[KeyframeWindow], seeds: Sequence[int]) -> list[WindowMotion]:
        """Several windows at once; a window's motion depends on its own seed only (to rounding).

        Raises:
            InputError: a window longer than the model's, or another frame rate.
        """
        for window in windows:
            _expect_fit(window, self.model.config.window_frames)
        filled: list[WindowMotion | None] = [None] * len(windows)
        todo = []
        for i, window in enumerate(windows):
            if is_exact(window) and window.is_keyframe.all():
                filled[i] = WindowMotion(window.R_parent_joint.copy(), window.translation_world_m.copy())
            else:
                todo.append(i)
        for noisy in (False, True):
            alike = [i for i in todo if is_exact(windows[i]) != noisy]
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
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        x0 = self._sampled(longer, x_keys, conditions, generators, noisy)
        features = self.model.statistics.denormalize(x0.cpu().double())
        local, moved = decode(features.numpy())
        R_parent_joint, translation_m = to_world(local, moved, frames)
        results = []
        for window, rotations, positions in zip(windows, R_parent_joint, translation_m, strict=True):
            count = len(window.is_keyframe)
            made = WindowMotion(nearest_rotation(rotations[:count]), positions[:count])
            results.append(fit_keyframes(made, _given(window), self._exact(window)))
        return results

    def _sampled(
        self,
        windows: list[KeyframeWindow],
        x_keys: Tensor,
        conditions: Conditions,
        generators: list[torch.Generator],
        noisy: bool,
    ) -> Tensor:
        """Normalized features (B, N, 201) of padded windows."""
        stop_step = self.sampler.stop_for(noisy)
        sampler = self.sampler
        x0 = sample(self._denoiser, self.schedule, x_keys, conditions, sampler, generators, stop_step=stop_step)
        smooth = []
        for window, features in zip(windows, x0.cpu().double().numpy(), strict=True):
            of_video = window.noise is not None and bool(window.noise.any())
            low_pass = butter(2, sampler.cutoff_for(window.noise_level, of_video), fs=FPS, output="sos")
            smooth.append(sosfiltfilt(low_pass, features, axis=0))
        return torch.from_numpy(np.stack(smooth))

    def _exact(self, window: KeyframeWindow) -> Bool[np.ndarray, "frames"]:
        """Frames that are met: the seed, and keyframes that carry no noise."""
        exact = np.arange(len(window.is_keyframe)) < window.seed_frames
        if self.sampler.hard_keyframes:
            exact |= window.is_keyframe & ~noise_of(window).any(1)
        return exact

    def _conditions(
        self, windows: list[KeyframeWindow], T_world_canonical: Float[np.ndarray, "batch 4 4"]
    ) -> tuple[Tensor, Conditions]:
        """Normalized keyframes (zero elsewhere) and what the denoiser is conditioned on."""
        statistics = self.model.statistics
        features = []
        for window, T in zip(windows, T_world_canonical, strict=True):
            keys = window.is_keyframe
            values = np.zeros((len(keys), FEATURE_COUNT), np.float32)
            motion = window.R_parent_joint[keys], window.translation_world_m[keys]
            values[keys] = statistics.normalize(encode(*motion, window.rest_joints_m, T))
            features.append(values)
        x_keys = self._tensor(np.stack(features))
        mask = self._tensor(np.stack([window.is_keyframe for window in windows]))
        base = join_keyframes(x_keys, mask)
        conditions = Conditions(
            mask=mask,
            imputed=mask,
            base=base,
            noise=self._tensor(np.stack([noise_of(window) for window in windows])),
            body=self._tensor(np.stack([statistics.normalize_body(lengths_of(window)) for window in windows])),
        )
        if isinstance(self.model.config, PaperConfig):
            return x_keys, replace(conditions, descriptors=self._descriptors(windows, T_world_canonical))
        around = statistics.denormalize(base)[..., JOINTS].unflatten(-1, (22, 3)).cpu().numpy()
        return x_keys, replace(conditions, field=grid_field(windows, T_world_canonical, around))

    def _descriptors(self, windows: list[KeyframeWindow], T_world_canonical: np.ndarray) -> Descriptors | None:
        """The paper's views of the scene; None where no window has one."""
        config = self.model.config
        assert isinstance(config, PaperConfig)
        if all(window.scene is None for window in windows):
            return None
        inputs = [self._scenes.read(window, T, config) for window, T in zip(windows, T_world_canonical, strict=True)]
        empty = np.zeros(config.grid, bool)
        known = self._tensor(np.array([one.occupancy is not None for one in inputs]))
        occupancy = np.stack([empty if one.occupancy is None else one.occupancy for one in inputs])
        local = self._tensor(np.stack([one.local_m for one in inputs]))
        return Descriptors(self._tensor(occupancy), local, known, known)

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.as_tensor(np.asarray(array, np.float32), device=self.device)


def load_diffusion_prior(
    folder: Path,
    *,
    device: str = "cpu",
    weights: str = "small",
    sampler: SamplerConfig | None = None,
    seed: int = 0,
) -> DiffusionPrior:
    """The prior with the weights `<folder>/<weights>.safetensors`, or those of a file path.

    Raises:
        ModelMissingError: no such weights.
        InputError: a damaged file.
    """
    path = Path(weights) if weights.endswith(".safetensors") else folder / f"{weights}.safetensors"
    return DiffusionPrior(load_weights(path), sampler, device=device, seed=seed)


def noise_of(window: KeyframeWindow) -> Float[np.ndarray, "frames 2"]:
    """Degrees and centimeters of every frame's noise; none in the seed."""
    level = min(window.noise_level, TRAINED_NOISE)
    noise = np.full((len(window.is_keyframe), 2), level) if window.noise is None else window.noise.copy()
    noise[: window.seed_frames] = 0.0
    return noise


def grid_field(
    windows: Sequence[KeyframeWindow], T_world_canonical: np.ndarray, around_m: Float[np.ndarray, "batch frames 22 3"]
) -> GridField | None:
    """Signed distances around each window's joined keyframes; None where no window has a scene."""
    if all(window.scene is None for window in windows):
        return None
    grids = []
    for window, T, points_m in zip(windows, T_world_canonical, around_m, strict=True):
        flat = points_m.reshape(-1, 3).astype(np.float64)
        grids.append(None if window.scene is None else canonical_grid(window.scene, flat, T))
    return GridField(tuple(grids))


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
    if abs(window.fps - FPS) > 0.01:
        raise InputError(f"prior scenemi: want {FPS:g} frames per second, got {window.fps:g}; resample first")
