"""What a training run is."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, TypeAdapter, ValidationError

from scenemi.data.plain_files import read_json
from scenemi.model.config import SIZES, AnyConfig, BaselineConfig, Method, ModelConfig, config_from_json
from scenemi.prior import DEFAULT_STOP_STEP
from video2anim.errors import InputError, UsageError

Share = Annotated[float, Field(ge=0, le=1)]
Weight = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0)]
Some = Annotated[int, Field(ge=1)]


@dataclass(frozen=True, slots=True)
class TrainConfig:
    """One run. All but the settings of `FREE` change the weights and must stay as they are when it is resumed."""

    model: AnyConfig = field(default_factory=lambda: SIZES["small"])
    batch: Annotated[int, Field(ge=1, le=65_536)] = 32
    """Windows whose gradients are taken at once (not measured)."""
    parts: Annotated[int, Field(ge=1, le=1024)] = 2
    """Batches of a step, whose gradients are averaged. On a CPU with more threads than one each batch has a process of
    its own: 66 windows/s on one core, 115 on two (`benchmarks/scenemi/training_speed.py`)."""
    learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1e-3
    """Rises over `warmup` steps and stays (paper: 1e-4 at batch 256): the end of a run is not known. The average of
    weights that ships needs no fall; `cool` makes one on demand."""
    warmup: Count = 150
    """Steps (not measured)."""
    weight_decay: Weight = 1e-2
    """Of the paper."""
    ema: Annotated[float, Field(gt=0, le=0.25)] = 0.1
    """Width of the weights' moving average as a share of the steps so far (Karras et al. 2024); the paper's constant
    decay 0.9999 suits one length of run only."""
    clip_norm: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    bodies: Annotated[int, Field(ge=1, le=255)] = 8
    """Adult bodies the clips are put on."""
    sources: tuple[str, ...] | None = None
    """Only clips of these sources, whatever their license; None = all that are free for commercial use."""
    pool_windows: Some = 32_768
    """Windows with scenes made once and kept (`scenemi.training.pool`); a run begins with the first of them."""
    bends: Annotated[int, Field(ge=0, le=100)] = 1
    """Each clip that goes somewhere is also bent along so many curves (`scenemi.data.bend`)."""
    synthetic_share: Share = 0.2
    """Share of the windows from acted (synthetic) clips, where there are any."""
    reverse: Share = 0.2
    """Share of windows run backward in time, and `mix`: share with the arms and the head of another window. Captured
    motion is scarce, and what networks learn of it by heart does not hold for other clips."""
    mix: Share = 0.2
    restyle: Share = 0.0
    """Share of windows whose trunk, arms and head swing more or less widely (`scenemi.data.augment.restyled`)."""
    keyframes: Literal["paper", "mixed"] = "mixed"
    """`paper`: 2 to N random ones. `mixed`: see `scenemi.training.keyframe_masks`."""
    noisy_share: Share = 0.15
    """Share of windows with noisy keyframes, l ~ U(0, 1) (paper 3.2.1: all); the others have exact ones."""
    pipeline_share: Share = 0.1
    """Share of windows observed as the video pipeline observes, with its errors (where a run is given any). Each weighs
    as much in the loss as five others."""
    first_step_share: Share = 0.8
    """Share of windows at t = T, where nothing of the answer is seen. It takes most of the training: what is left to
    learn at the other steps (drawn evenly, paper: all) is soon learnt, and the default sampler takes this one alone."""
    stop_step: Annotated[int, Field(ge=0, le=1000)] = DEFAULT_STOP_STEP
    """T*: noisy keyframes are imputed above this step only."""
    scene_share: Share = 0.6
    """Share of windows that are shown their scene; the others have none, as many uses have none."""
    drop_global: Share = 0.1
    """Share of the scenes of which only the local part is given, `drop_local` only the global part (paper's form)."""
    drop_local: Share = drop_global
    joints_weight: Weight = 2.0
    velocity_weight: Weight = 0.02
    """Paper's form: 2 and 10, on squared meters."""
    acceleration_weight: Weight = 0.002
    """Errors of a millimeter that change every frame count for nothing else. Captured velocities and accelerations are
    mostly noise to the model: ten and twenty-five times these weights left the joints' error at 0.51 after 375 steps,
    none at 0.28 (m^2 over 22 joints)."""
    inside_weight: Weight = 0.1
    """Of joints nearer to solids than the truth, per centimeter."""
    relative: bool = True
    """Errors count relative to those of the joined keyframes at the same distance from a keyframe, and robustly. Else
    (the paper's eq. 4) the loss is ruled by the sparsest keyframes, where most of the error cannot be known."""
    workers: Annotated[int, Field(ge=0, le=1024)] = 1
    """Threads that make batches ahead."""
    log_every: Some = 50
    """Steps from line to line of `log.csv`: a minute and a half at 36 windows/s."""
    save_every: Some = 300
    """Steps between two checkpoints: nine minutes at 36 windows/s."""
    grow_every: Some = 500
    """Steps between two shards of the pool, until it has all its windows."""
    validate_every: Some = 1000
    """Steps between two validations (not measured)."""

    @property
    def step_windows(self) -> int:
        """Windows of a step."""
        return self.batch * self.parts

    def of_method(self, method: str) -> TrainConfig:
        """The same run of a baseline about as large as the model: windows, steps and rate stay as they are; the
        objective is the paper's, at evenly drawn steps of the diffusion, and keyframes are exact.

        Raises:
            UsageError: an unknown method, or a model that is not of the shipped form.
        """
        if method not in METHODS:
            raise UsageError(f"method: want {', '.join(METHODS)}, got {method[:40]}")
        if not isinstance(self.model, ModelConfig):
            raise UsageError(f"method: want a configuration of the shipped form for the size of {method}")
        model = BaselineConfig.like(next(name for name in METHODS if name == method), self.model)
        paper = TrainConfig.read("paper")
        return replace(self, model=model, noisy_share=0.0, **{name: getattr(paper, name) for name in OBJECTIVE})

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {**asdict(self), "model": self.model.to_json()}

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> TrainConfig:
        """Inverse of `to_json`; `model` may be a size by name, and missing keys take defaults.

        Raises:
            InputError: an unknown key or a value that does not fit.
        """
        known = {item.name for item in fields(cls)}
        unknown = set(values) - known
        if unknown:
            told = ", ".join(sorted(repr(str(name))[1:-1] for name in unknown))
            raise InputError(f"training config: unknown {told}; known are {', '.join(sorted(known))}")
        try:
            return _CHECKED.validate_python({**values, "model": _model(values.get("model", "small"))})
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            got = repr(first["input"])[:80]
            raise InputError(f"training config: {where}: {first['msg']}, got {got}") from error

    @classmethod
    def read(cls, path: str | Path) -> TrainConfig:
        """From a JSON file, or one of the shipped configurations by its name.

        Raises:
            UsageError: no such name.
            InputError: the file is missing or not such a table.
        """
        file = Path(path)
        if file.suffix != ".json":
            file = configs_folder() / f"{path}.json"
            if str(path) not in shipped_configs():
                raise UsageError(
                    f"training config: want a .json file or one of {', '.join(shipped_configs())}, got {path}"
                )
        return cls.from_json(read_json(file, "training config"))


def configs_folder() -> Path:
    """Of the shipped configurations: inside the installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "configs"
    return installed if installed.is_dir() else package.parent / "configs" / "scenemi"


def shipped_configs() -> list[str]:
    """Names of the shipped configurations."""
    return sorted(path.stem for path in configs_folder().glob("*.json"))


def _model(given: Any) -> AnyConfig:
    """A size by name, a size with changes, or all of a configuration."""
    if isinstance(given, str):
        given = {"size": given}
    if not isinstance(given, dict):
        raise InputError(f"training config: model: want a size by name or a table, got {repr(given)[:80]}")
    size = given.get("size", None if given.get("form") else "small")
    if size is not None and (not isinstance(size, str) or size not in SIZES):
        raise InputError(f"training config: model: want {', '.join(SIZES)} or a table, got {repr(size)[:80]}")
    changes = {key: value for key, value in given.items() if key != "size"}
    try:
        return config_from_json({**(SIZES[size].to_json() if size else {}), **changes})
    except ValueError as error:
        raise InputError(f"training config: {error}") from error


_CHECKED = TypeAdapter(TrainConfig)
METHODS: tuple[Method, ...] = get_args(Method)
"""Baselines of `scenemi train --method`."""
OBJECTIVE = (
    "relative", "joints_weight", "velocity_weight", "acceleration_weight", "inside_weight", "first_step_share",
    "pipeline_share",
)  # fmt: skip
"""Settings of `paper.json` that make the paper's objective."""
FREE = ("workers", "log_every", "save_every", "grow_every", "validate_every", "pool_windows")
"""Settings in which a resumed run may differ."""
