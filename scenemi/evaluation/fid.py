"""The FID features that come with the package."""

from __future__ import annotations

from pathlib import Path

from scenemi.data.files import read_tensors
from scenemi.evaluation.motion_autoencoder import FidFeatures, from_tensors
from scenemi.evaluation.windows import adult_body
from video2anim.digest import file_digest
from video2anim.errors import ModelMissingError

FID_FILE = Path(__file__).parents[1] / "weights" / "fid" / "features.safetensors"
FID_DIGEST = "5558cd8daa9210571cbf273dccfa10e6ec8a9f0b4ea5ec25c2b49e79be7cc9e1"
"""SHA-256 of the file: numbers made with other features are not comparable."""


def shipped_features(path: Path = FID_FILE, digest: str = FID_DIGEST) -> FidFeatures:
    """Features for the evaluation's body.

    Raises:
        ModelMissingError: the file is absent or not the one that comes with this version.
    """
    if not path.is_file():
        raise ModelMissingError(f"FID features: no file {path}; install the package again, or run tools/train_fid.py")
    found = file_digest(path)
    if found != digest:
        raise ModelMissingError(f"FID features: {path} has digest {found[:12]}, want {digest[:12]}; install again")
    return FidFeatures(from_tensors(*read_tensors(path)), adult_body().rest_joints_m)
