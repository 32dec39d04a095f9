"""Single training pictures with labels, in shards of memory-mapped arrays."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from video2anim import __version__
from video2anim.artifacts.folder import whole_or_absent
from video2anim.errors import InputError
from video2anim.synth.generate import SynthConfig, checked_sources, clip_key, compose_options, start_worker
from video2anim.synth.presets import ClipSpec, clip_specs
from video2anim.synth.world import LABELS, SensorModel, Shot
from video2anim.types import Intrinsics

PER_ROOM = 8
"""Pictures made of one room, each from another camera and at another moment."""
SHARD_SIZE = 64
ARRAYS = {
    "rgb": (np.uint8, (3,)),
    "depth_mm": (np.uint16, ()),
    "normal_camera": (np.int8, (3,)),
    "instance": (np.uint16, ()),
    "label": (np.uint8, ()),
}
"""Per-pixel arrays of a shard: type and channels; each file is (pictures, height, width, channels)."""


@dataclass(frozen=True, slots=True)
class ShardDone:
    """What became of one shard."""

    name: str
    pictures: int
    cached: bool


def generate_frames(
    config: SynthConfig, out: Path, *, workers: int = 1, on_done: Callable[[ShardDone, int], None] = lambda d, n: None
) -> tuple[ShardDone, ...]:
    """Make `config.count` pictures (default 64) in `out/shard_<n>/<array>.npy`; a finished shard is kept.

    Besides `ARRAYS` a shard holds `intrinsics.npy` (n, 4) fx fy cx cy in pixels, `distortion.npy` (n, 2) k1 k2,
    `up_camera.npy` (n, 3), `camera_height_m.npy` (n,), and `meta.json`.

    Raises:
        UsageError: preset or count is wrong.
        InputError: sources or output folder cannot be used.
    """
    count = SHARD_SIZE if config.count is None else config.count
    rooms = -(-count // PER_ROOM)
    specs = clip_specs("random", rooms, config.seed)
    sources = checked_sources(config)
    jobs = []
    for shard, first in enumerate(range(0, count, SHARD_SIZE)):
        size = min(SHARD_SIZE, count - first)
        start = first // PER_ROOM
        jobs.append((f"shard_{shard:05d}", specs[start : start + -(-size // PER_ROOM)], size))
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out: cannot make folder {out}: {error.strerror}; choose another") from error
    results = []
    for result in _made(jobs, config, sources, out, workers):
        results.append(result)
        on_done(result, len(jobs))
    return tuple(sorted(results, key=lambda shard: shard.name))


def _made(
    jobs: list[tuple[str, tuple[ClipSpec, ...], int]],
    config: SynthConfig,
    sources: dict[str, str],
    out: Path,
    workers: int,
) -> Iterator[ShardDone]:
    if workers <= 1 or len(jobs) <= 1:
        for name, specs, size in jobs:
            yield _shard(name, specs, size, config, sources, out)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(jobs)), mp_context=context, initializer=start_worker) as pool:
        for future in [pool.submit(_shard, name, specs, size, config, sources, out) for name, specs, size in jobs]:
            yield future.result()


def _shard(
    name: str, specs: tuple[ClipSpec, ...], size: int, config: SynthConfig, sources: dict[str, str], out: Path
) -> ShardDone:
    folder = out / name
    meta = {
        "format_version": 1, "preset": "random", "seed": config.seed, "first_room": specs[0].index, "pictures": size,
        "width_px": config.width_px, "height_px": config.height_px, "labels": list(LABELS),
        "generator": f"video2anim {__version__}", "key": clip_key(specs[0], config, sources),
    }  # fmt: skip
    try:
        if json.loads((folder / "meta.json").read_text()) == meta:
            return ShardDone(name, size, True)
    except (OSError, ValueError):
        pass
    with whole_or_absent(folder) as work:
        shape = (size, config.height_px, config.width_px)
        maps = {
            key: np.lib.format.open_memmap(work / f"{key}.npy", "w+", np.dtype(kind), (*shape, *channels))
            for key, (kind, channels) in ARRAYS.items()
        }
        facts: dict[str, list[np.ndarray]] = {
            k: [] for k in ("intrinsics", "distortion", "up_camera", "camera_height_m")
        }
        row = 0
        for spec in specs:
            for values in _pictures(spec, config, min(PER_ROOM, size - row)):
                for key in ARRAYS:
                    maps[key][row] = values[key]
                for key, rows in facts.items():
                    rows.append(values[key])
                row += 1
        for array in maps.values():
            array.flush()
        for key, rows in facts.items():
            np.save(work / f"{key}.npy", np.stack(rows).astype(np.float32), allow_pickle=False)
        (work / "meta.json").write_text(json.dumps(meta, indent=1) + "\n")
    return ShardDone(name, size, False)


def _pictures(spec: ClipSpec, config: SynthConfig, count: int) -> Iterator[dict[str, np.ndarray]]:
    from video2anim.synth.cameras import CameraRequest, place_camera
    from video2anim.synth.compose import compose, draw_sensor
    from video2anim.synth.render import PERSON_ID, Renderer, Sensor
    from video2anim.synth.store import depth_code, normal_code

    shot = compose(spec, compose_options(config))
    request = CameraRequest(
        config.width_px, config.height_px, pitch_rad=(-0.9, 0.35), roll_sigma_rad=0.06, nearest_m=1.0,
        figure_ratio=(0.1, 2.0), least_seen=0.3,
    )  # fmt: skip
    for number in range(count):
        rng = spec.rng(f"picture {number}")
        t = int(rng.integers(0, shot.frame_count))
        joints = np.stack([actor.motion.joints_world_m[t : t + 1] for actor in shot.actors])
        try:
            lens, pose = place_camera(rng, shot.room, joints, request)
        except InputError:
            lens, pose = shot.intrinsics, shot.T_world_camera[t : t + 1]
        sensor = draw_sensor(rng, replace(spec, harsh=True), lens)
        single = _frozen(shot, t, lens, pose, sensor)
        picture = Renderer(single).frame(0)
        label = np.zeros(picture.instance.shape, np.uint8)
        for thing in (*shot.room.objects, *(moving.thing for moving in shot.moving)):
            label[picture.instance == thing.object_id] = LABELS.index(thing.label)
        label[picture.instance >= PERSON_ID] = LABELS.index("person")
        yield {
            "rgb": Sensor(sensor, rng).apply(picture.rgb, 0),
            "depth_mm": depth_code(picture.depth_m),
            "normal_camera": normal_code(picture.normal_camera),
            "instance": picture.instance,
            "label": label,
            "intrinsics": np.array([lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px]),
            "distortion": np.array([sensor.k1, sensor.k2]),
            "up_camera": pose[0, 1, :3],
            "camera_height_m": pose[0, 1, 3],
        }


def _frozen(shot: Shot, t: int, lens: Intrinsics, pose: np.ndarray, sensor: SensorModel) -> Shot:
    """One moment of a shot from another camera. Without neighbours in time there is no motion blur."""
    actors = []
    for actor in shot.actors:
        motion = actor.motion
        still = replace(
            motion, frame_time_s=motion.frame_time_s[:1], valid=motion.valid[t : t + 1],
            T_world_root=motion.T_world_root[t : t + 1], R_parent_joint=motion.R_parent_joint[t : t + 1],
            T_world_camera=pose, intrinsics=lens, contact=motion.contact[t : t + 1],
            joints_world_m=motion.joints_world_m[t : t + 1],
        )  # fmt: skip
        actors.append(replace(actor, motion=still))
    moving = tuple(replace(item, T_world_object=item.T_world_object[t : t + 1]) for item in shot.moving)
    return replace(
        shot, actors=tuple(actors), intrinsics=lens, T_world_camera=pose, is_static=True, sensor=sensor, moving=moving
    )
