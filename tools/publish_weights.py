"""Copies the averaged weights of a training run into the package, with a model card.

    python tools/publish_weights.py run/weights.safetensors --numbers benchmarks/scenemi/results/reach.json

Writes `scenemi/weights/<name>.safetensors` (fp16) and `<name>.md`. Weights trained on clips that are not free for
commercial use, or whose license is not confirmed, are rejected.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path
from typing import Any

from scenemi.data.sources import attribution_of, is_free, license_of
from scenemi.model.weights import WEIGHTS_FOLDER, load_weights
from video2anim.digest import file_digest

CARD = """# SceneMI weights `{name}`

Denoiser of scene-aware motion in-betweening: 121 frames at 30 per second, 22 joints, keyframes exact or noisy, with or
without a scene. Trained with the configuration below.

| | |
|---|---|
| data | {minutes:.0f} minutes of train clips: {sources} |
| bodies | {bodies} adults (Anny) |
| scenes | made around each window (`scenemi.scene.pseudo`): the data has none |
| parameters | {parameters:.1f} million, fp16 |
| steps | {steps} of {batch} windows, {hours:.1f} hours on {machine} |
| license | Apache-2.0 |
| sha256 | `{digest}` |

Use: filling motion between keyframes of adults walking, turning, sitting, picking up, reaching, stepping up.
The tables show how far it removes noise of keyframes and of motion estimated from video. \
Its training data has little running,
dancing and sport, no children, no slopes, and rooms of boxes only. Its motions are samples: plausible, not measured.

{numbers}
{attribution}
```json
{config}
```
"""


def barred_sources(card: dict[str, Any]) -> dict[str, str]:
    """License by source, for the sources of a card that are not known to be free for commercial use.

    Cards of older runs have no licenses; those of the sources are then looked up.
    """
    known = card.get("licenses", {})
    licenses = {source: known.get(source, license_of(source)) for source in card["sources"]}
    return {source: license_name for source, license_name in licenses.items() if not is_free(license_name)}


def main() -> None:
    """Check the sources of the weights, copy the weights, write their card."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path, help="weights written by `scenemi train`")
    parser.add_argument("--name", default="small")
    parser.add_argument("--machine", default="2 CPU cores shared with other work")
    parser.add_argument("--numbers", type=Path, help="Markdown file with the tables of the card")
    options = parser.parse_args()
    model = load_weights(options.weights)
    barred = barred_sources(model.card)
    if barred:
        listed = ", ".join(f"{source} ({license_name})" for source, license_name in barred.items())
        raise SystemExit(
            f"publish_weights: {options.weights} was trained on {listed}, not known to be free: not to be shipped"
        )
    target = WEIGHTS_FOLDER / f"{options.name}.safetensors"
    shutil.copyfile(options.weights, target)
    config = model.card["config"]
    card = CARD.format(
        name=options.name,
        sources=", ".join(model.card["sources"]),
        minutes=model.card["minutes"],
        bodies=config["bodies"],
        parameters=sum(p.numel() for p in model.denoiser.parameters()) / 1e6,
        steps=model.card["steps"],
        batch=config["batch"] * config.get("parts", 1),
        hours=model.card["hours"],
        machine=options.machine,
        digest=file_digest(target),
        numbers=options.numbers.read_text() if options.numbers else "",
        attribution=attribution_of(model.card["sources"]),
        config=json.dumps(config, indent=1),
    )
    target.with_suffix(".md").write_text(card)
    sys.stdout.write(f"{target} {target.stat().st_size} bytes\n")


if __name__ == "__main__":
    main()
