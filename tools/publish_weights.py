"""Put the averaged weights of a training run into the package, with their model card.

    python tools/publish_weights.py run/checkpoint.safetensors --motion cmu.npz deepmimic.npz acted.npz \
        --split split.json --name small --numbers benchmarks/scenemi/results/table_reach.json

Writes `scenemi/weights/<name>.safetensors` (fp16) and `<name>.md`.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from scenemi.data.balance import BalanceConfig
from scenemi.data.sources import is_free
from scenemi.data.split import Split
from scenemi.data.windows import MotionSet, MotionSetConfig
from scenemi.files import file_digest
from scenemi.model.denoiser import Denoiser
from scenemi.model.weights import WEIGHTS_FOLDER, save_weights
from scenemi.training.checkpoint import load_checkpoint

CARD = """# SceneMI weights `{name}`

Denoiser of scene-aware motion in-betweening: 121 frames at 30 per second, 22 joints, keyframes exact or noisy, with or
without a scene around. Trained by `scenemi train` with the configuration below.

| | |
|---|---|
| data | {minutes:.0f} minutes of train clips: {sources} |
| bodies | {bodies} adults (Anny) |
| scenes | made around each window (`scenemi.scene.pseudo`): the data has none |
| parameters | {parameters:.1f} million, fp16 |
| steps | {step} of {batch} windows, {hours:.1f} hours on {machine} |
| licence | {licence} |
| sha256 | `{digest}` |

Use: filling motion between keyframes of adults walking, turning, sitting, picking up, reaching, stepping up. It has
seen little running, dancing and sport, no children, no slopes, and rooms of boxes only. Its motions are samples:
plausible, not measured.

{note}{numbers}
{attribution}
```json
{config}
```
"""
ATTRIBUTION = """\
The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF
EIA-0196217. DeepMimic: MIT, (c) 2018 Xue Bin Peng; arpspoof/Jump: MIT, (c) 2021 arpspoof. Synthetic clips were made by
`video2anim synth`.
"""
NONCOMMERCIAL = """\
Also trained on the Bandai-Namco Research Motiondataset ((c) 2022 Bandai Namco Research Inc.) and clips of Sony
Interactive Entertainment ((c) 2021), both CC BY-NC 4.0: **not for commercial use**.
"""


def main() -> None:
    """Read the run, write weights and card."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--motion", type=Path, nargs="+", required=True)
    parser.add_argument("--split", type=Path, required=True)
    parser.add_argument("--name", default="small")
    parser.add_argument("--machine", default="2 CPU cores")
    parser.add_argument("--note", default="", help="What else is to be said of the run.")
    parser.add_argument("--numbers", type=Path, help="JSON of benchmarks/scenemi/tables.py reach")
    options = parser.parse_args()
    state = load_checkpoint(options.checkpoint)
    config = state.config
    use = MotionSetConfig(
        noncommercial=config.noncommercial, balance=BalanceConfig(source_share={"synthetic": config.synthetic_share})
    )
    motions = MotionSet.build(options.motion, Split.read(options.split), "train", 1, use)
    sources = sorted({str(source) for source in motions.store.clip_source})
    model = Denoiser(config.model)
    model.load_state_dict(state.ema)
    free = all(is_free(source) for source in sources)
    facts = {
        "name": options.name, "steps": state.step, "minutes": round(motions.minutes, 1), "sources": sources,
        "licence": "Apache-2.0" if free else "CC BY-NC 4.0", "training": config.to_json(),
    }  # fmt: skip
    target = WEIGHTS_FOLDER / f"{options.name}.safetensors"
    save_weights(target, model, state.statistics, facts)
    target.chmod(0o644)
    card = CARD.format(
        name=options.name,
        minutes=motions.minutes,
        sources=", ".join(sources),
        bodies=config.bodies,
        parameters=sum(p.numel() for p in model.parameters()) / 1e6,
        step=state.step,
        batch=config.batch,
        hours=state.seconds / 3600,
        machine=options.machine,
        licence=facts["licence"],
        digest=file_digest(target),
        note=f"{options.note}\n\n" if options.note else "",
        numbers=table(options.numbers) if options.numbers else "",
        attribution=ATTRIBUTION + ("" if free else NONCOMMERCIAL),
        config=json.dumps(config.to_json(), indent=1),
    )
    target.with_suffix(".md").write_text(card)
    sys.stdout.write(f"{target} {target.stat().st_size} bytes\n")


def table(path: Path) -> str:
    """The Markdown beside the numbers' JSON."""
    return path.with_suffix(".md").read_text()


if __name__ == "__main__":
    main()
