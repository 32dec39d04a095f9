"""A run of a few steps."""

from scenemi.data.windows import MotionSetConfig
from scenemi.model.config import SIZES
from scenemi.training.config import TrainConfig

CONFIG = TrainConfig(
    model=SIZES["tiny"],
    steps=6,
    batch=4,
    workers=0,
    log_every=1,
    save_every=2,
    warmup=2,
    bodies=1,
    validate_every=100,
    joiner_steps=3,
    joiner_batch=4,
    joiner_windows=64,
)
PLAIN = MotionSetConfig(mirror=0.0, warp=0.0)
