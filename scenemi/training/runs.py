"""A run's configuration with its motion, and the weights that come out of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from scenemi.data.balance import BalanceConfig
from scenemi.data.container import MotionArchive
from scenemi.data.motion_store import StoreConfig
from scenemi.data.scene_clips import scene_folders
from scenemi.data.sources import is_free, license_of
from scenemi.data.split import Split
from scenemi.data.windows import MotionSet, MotionSetConfig, archives_of, barred_clips
from scenemi.model.baselines.build import build_any
from scenemi.model.weights import save_weights
from scenemi.training.checkpoint import Checkpoint
from scenemi.training.config import TrainConfig
from scenemi.training.scene_pool import SceneMotions, prepare_scenes
from video2anim.errors import InputError, UsageError


@dataclass(frozen=True, slots=True)
class RunFiles:
    """What a run is made of."""

    config: TrainConfig
    motion: tuple[Path, ...]
    """Archives or folders of archives."""
    split: Split | None
    cache: Path | None
    scenes: tuple[tuple[str, Path], ...] = ()
    """Name and folder of data sets with captured scenes."""
    noncommercial: bool = False
    """Also train on clips whose license is not known to be free for commercial use."""

    @classmethod
    def of(
        cls,
        config: str | Path | None,
        motion: Sequence[Path],
        split: Path | None,
        cache: Path | None,
        scenes: Sequence[str] = (),
        *,
        noncommercial: bool = False,
    ) -> RunFiles:
        """From what a command line names; the default configuration is `TrainConfig()`, that of the size that ships.

        Raises:
            UsageError: neither motion nor scenes, or scenes that are not `source=folder`.
            InputError: a file is missing or broken.
        """
        if not motion and not scenes:
            raise UsageError("training: want --motion FILE or --scenes SOURCE=FOLDER, got neither")
        run = TrainConfig() if config is None else TrainConfig.read(config)
        return cls(
            run,
            tuple(motion),
            None if split is None else Split.read(split),
            cache,
            scene_folders(scenes),
            noncommercial,
        )


@dataclass(frozen=True, slots=True, eq=False)
class RunClips:
    """What a run trains on."""

    motions: MotionSet
    scenes: SceneMotions | None
    """Clips in captured scenes beside those of `motions`; None = none, or `motions` are such clips."""
    watched: MotionSet | None
    """Clips for validation."""

    @property
    def sets(self) -> tuple[MotionSet, ...]:
        """Of clips to train on."""
        return (self.motions,) if self.scenes is None else (self.motions, self.scenes)


def clips_for(files: RunFiles, out: Path) -> RunClips:
    """Clips of archives, of data sets with captured scenes, or of both.

    Args:
        files: of the run.
        out: of the run; data sets are converted here where `files.cache` is not given.

    Raises:
        InputError: no clip to train on, or a data set that the configuration does not name.
    """
    if not files.scenes:
        motions, watched = motions_for(files)
        return RunClips(motions, None, watched)
    config = files.config
    for source, _ in files.scenes:
        if source not in (config.sources or ()) and not files.noncommercial:
            raise InputError(
                f"training: {source} is not free for commercial use; where that is right, name it in `sources` of the "
                f"configuration, as in configs/scenemi/{source}.json, or add --noncommercial"
            )
    use = MotionSetConfig(files.noncommercial, config.sources, reverse=config.reverse)
    into = files.cache or out / "scenes"
    folders = [prepare_scenes(source, folder, into) for source, folder in files.scenes]
    scenes = SceneMotions.read(folders, files.split, "train", config.bodies, use, cache=files.cache)
    if files.motion:
        motions, watched = motions_for(files)
        return RunClips(motions, scenes, watched)
    try:
        return RunClips(scenes, None, SceneMotions.read(folders, files.split, "val", 1, use, cache=files.cache))
    except InputError:
        return RunClips(scenes, None, None)


def motions_for(files: RunFiles) -> tuple[MotionSet, MotionSet | None]:
    """Clips to train on, and clips to watch the run by, where there are any.

    Raises:
        InputError: no clip to train on.
    """
    motions = MotionSet.build(
        files.motion, files.split, "train", files.config.bodies, drawn_from(files), cache=files.cache
    )
    try:
        return motions, watched_for(files)
    except InputError:
        return motions, None


def watched_for(files: RunFiles) -> MotionSet:
    """Clips to watch the run by.

    Raises:
        InputError: there are none.
    """
    use = replace(drawn_from(files), store=StoreConfig(), reverse=0.0, mix=0.0, restyle=0.0)
    return MotionSet.build(files.motion, files.split, "val", 1, use, cache=files.cache)


def drawn_from(files: RunFiles) -> MotionSetConfig:
    """How windows are drawn for training."""
    config = files.config
    return MotionSetConfig(
        files.noncommercial, config.sources, balance=BalanceConfig(source_share={"synthetic": config.synthetic_share}),
        store=StoreConfig(bends=config.bends), reverse=config.reverse, mix=config.mix, restyle=config.restyle,
    )  # fmt: skip


def left_out(files: RunFiles) -> list[str]:
    """Sentences about clips that are not trained on for their license."""
    if files.noncommercial or files.config.sources is not None or not files.motion:
        return []
    return [
        f"{count} clips of {source} (license {license_name}) are not known to be free for commercial use and left out; "
        "--noncommercial trains on them, for weights that may not be used commercially"
        for (source, license_name), count in sorted(barred_clips(files.motion).items())
    ]


def licenses_of(files: RunFiles, *motions: MotionSet) -> dict[str, str]:
    """License of each source that clips were taken of; of several, the first that is not free."""
    used = {str(name) for one in motions for name in one.store.clip_name}
    rows = {
        (source, license_name)
        for archive in map(MotionArchive.read, archives_of(files.motion))
        for name, source, license_name in zip(archive.names, archive.sources, archive.licenses, strict=True)
        if name in used
    }
    rows |= {(source, license_of(source)) for source, _ in files.scenes}
    return dict(sorted(rows, key=lambda row: (not is_free(row[1]), row)))


def write_run_weights(
    path: Path, state: Checkpoint, *motions: MotionSet, licenses: Mapping[str, str] | None = None
) -> Path:
    """The averaged weights of a run (fp16) with what they were trained on; licenses of sources by `licenses_of`, or as
    the sources are known by their names."""
    sources = sorted({str(source) for one in motions for source in one.store.clip_source})
    model = build_any(state.config.model)
    model.load_state_dict({name: value.cpu() for name, value in state.ema.items()})
    card = {
        "steps": state.step, "hours": round(state.seconds / 3600, 2),
        "minutes": round(sum(one.minutes for one in motions), 1),
        "sources": sources,
        "licenses": {source: (licenses or {}).get(source, license_of(source)) for source in sources},
        "config": state.config.to_json(),
    }  # fmt: skip
    save_weights(path, model, state.statistics, card)
    return path
