"""Trains the motion features of the FID (scenemi/evaluation/motion_autoencoder.py) on clips free for commercial use.

    python tools/train_fid.py --motion cmu.npz deepmimic.npz --split split.json --out scenemi/weights/fid

Writes `features.safetensors` and `CARD.md`, and prints the digest that `scenemi/evaluation/fid.py` expects. A few
minutes on one CPU core.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import save_file

from scenemi.data.augment import mirrored
from scenemi.data.container import MotionArchive, read_split
from scenemi.data.retarget import retarget
from scenemi.evaluation.motion_autoencoder import AutoencoderConfig, MotionAutoencoder, motion_channels, to_tensors
from scenemi.evaluation.windows import adult_body
from scenemi.windows import WINDOW_FRAMES
from video2anim.digest import file_digest

SHORTEST_FRAMES = 61
"""Minimum length of clips. Clips shorter than a window are padded with their last pose."""
STRIDE_FRAMES = 10
CARD = """# Motion features of the FID

Encoder of a convolutional autoencoder over 121-frame windows ({code} features), used by `scenemi evaluate` and the
tables of `benchmarks/scenemi`. Distances are comparable only between motions measured with this file, not with other
papers' FID.

| | |
|---|---|
| data | train split of CMU and the MIT part of DeepMimic: {clips} clips, {minutes:.0f} minutes, {windows} windows |
| body | average adult |
| steps | {steps} of batch {batch}, seed {seed} |
| reconstruction error | {train:.3f} train, {val:.3f} val (mean square, in standard deviations) |
| sha256 | `{digest}` |
| license | Apache-2.0 |

The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF
EIA-0196217. DeepMimic: MIT, (c) 2018 Xue Bin Peng; arpspoof/Jump: MIT, (c) 2021 arpspoof.
"""


def main() -> None:
    """Read the clips, train the network, write weights and card."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motion", type=Path, nargs="+", required=True)
    parser.add_argument("--split", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.manual_seed(options.seed)
    split = read_split(options.split)
    archives = [MotionArchive.read(path) for path in options.motion]
    train, clips, frames = windows_of(archives, split["train"])
    val, _, _ = windows_of(archives, split["val"])
    model = MotionAutoencoder(AutoencoderConfig())
    model.standardize(train)
    final = fit(model, train, val, options.steps, options.batch, options.seed)
    numbers = {"clips": clips, "minutes": frames / 30 / 60, "windows": len(train), "steps": options.steps}
    numbers |= {"batch": options.batch, "seed": options.seed, "train": final[0], "val": final[1]}
    arrays, text = to_tensors(model, numbers)
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / "features.safetensors"
    save_file(arrays, target, text)
    target.chmod(0o644)
    digest = file_digest(target)
    card = CARD.format(code=model.config.code, digest=digest, **numbers)
    (options.out / "CARD.md").write_text(card)
    sys.stdout.write(f"{card}\n{target.stat().st_size} bytes\n")


def windows_of(archives: list[MotionArchive], names: tuple[str, ...]) -> tuple[torch.Tensor, int, int]:
    """Overlapping windows (n, channels, frames) of the free clips of one part and their mirror images, on the average
    adult; number of clips and of frames."""
    body, wanted = adult_body(), set(names)
    found, clips, frames = [], 0, 0
    for archive in archives:
        for name, free, count in zip(archive.names, archive.free, archive.frame_counts, strict=True):
            if name not in wanted or not free or count < SHORTEST_FRAMES:
                continue
            motion = retarget(archive.clip(name), body)
            clips, frames = clips + 1, frames + count
            for side in (motion, mirrored(motion)):
                for start in range(0, max(1, count - WINDOW_FRAMES + 1), STRIDE_FRAMES):
                    index = np.minimum(np.arange(start, start + WINDOW_FRAMES), count - 1)
                    found.append(
                        motion_channels(side.R_parent_joint[index], side.translation_m[index], body.rest_joints_m)
                    )
    return torch.from_numpy(np.stack(found)), clips, frames


def fit(
    model: MotionAutoencoder, train: torch.Tensor, val: torch.Tensor, steps: int, batch: int, seed: int
) -> tuple[float, float]:
    """Train with Adam and a falling rate. Returns the mean loss of the last tenth of the steps, and the validation
    loss."""
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-3, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, max_lr=2e-3, total_steps=steps)
    generator = torch.Generator().manual_seed(seed)
    losses, start = [], time.perf_counter()
    for step in range(steps):
        loss = model.loss(train[torch.randint(len(train), (batch,), generator=generator)])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(float(loss.detach()))
        if step % 250 == 249:
            with torch.no_grad():
                checked = float(model.loss(val))
            spent = time.perf_counter() - start
            sys.stderr.write(f"step {step + 1}: train {np.mean(losses[-250:]):.4f} val {checked:.4f} ({spent:.0f} s)\n")
    with torch.no_grad():
        return float(np.mean(losses[-steps // 10 :])), float(model.loss(val))


if __name__ == "__main__":
    main()
