"""Compares BlazePose in LiteRT with the same network converted to ONNX: outputs and speed on frames of a clip.

    pip install tensorflow-cpu tf2onnx   # in an environment of its own
    python -m tf2onnx.convert --tflite blazepose-heavy.tflite --output heavy.onnx --opset 18
    python benchmarks/litert_or_onnx.py --tflite blazepose-heavy.tflite --onnx heavy.onnx --video clip.mp4

Outputs are paired by shape. Speed is the median of alternating runs, so that both have the same system load.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import sys
import time
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import onnxruntime
from ai_edge_litert.interpreter import Interpreter


def main() -> None:
    """Compare, print and write the numbers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tflite", type=Path, required=True)
    parser.add_argument("--onnx", type=Path, required=True)
    parser.add_argument("--video", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, help="JSON to write")
    options = parser.parse_args()
    tflite = Interpreter(str(options.tflite), num_threads=options.threads)
    tflite.allocate_tensors()
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = options.threads
    session = onnxruntime.InferenceSession(str(options.onnx), settings, providers=["CPUExecutionProvider"])
    _, height, width, _ = tflite.get_input_details()[0]["shape"]
    worst: dict[str, tuple[float, float]] = {}
    seconds: dict[str, list[float]] = {"litert": [], "onnxruntime": []}
    for picture in pictures(options.video, options.frames, width, height):
        first = timed(seconds["litert"], lambda x=picture: run_tflite(tflite, x))
        second = timed(seconds["onnxruntime"], lambda x=picture: run_onnx(session, x))
        for shape, values in first.items():
            off, size = worst.get(shape, (0.0, 0.0))
            found = float(np.abs(values - second[shape]).max())
            worst[shape] = max(off, found), max(size, float(np.abs(values).max()))
    report = {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "network": options.tflite.name,
        "frames": options.frames,
        "threads": options.threads,
        "max_difference": {shape: {"difference": off, "of": size} for shape, (off, size) in worst.items()},
        "median_ms": {name: 1e3 * float(np.median(found[1:])) for name, found in seconds.items()},
    }
    text = json.dumps(report, indent=1) + "\n"
    if options.out is not None:
        options.out.write_text(text)
    sys.stdout.write(text)


def pictures(video: Path, count: int, width: int, height: int) -> list[np.ndarray]:
    """The first frames, resized to the network's input, (1, H, W, 3) float32 in [0, 1]."""
    found = []
    with av.open(str(video)) as container:
        for frame in container.decode(video=0):
            rgb = cv2.resize(frame.to_ndarray(format="rgb24"), (width, height), interpolation=cv2.INTER_AREA)
            found.append(rgb[None].astype(np.float32) / 255)
            if len(found) == count:
                break
    return found


def timed(seconds: list[float], run: Any) -> dict[str, np.ndarray]:
    """The result of `run`; its time is appended to `seconds`."""
    start = time.perf_counter()
    result: dict[str, np.ndarray] = run()
    seconds.append(time.perf_counter() - start)
    return result


def run_tflite(network: Interpreter, picture: np.ndarray) -> dict[str, np.ndarray]:
    """Outputs by shape."""
    network.set_tensor(network.get_input_details()[0]["index"], picture)
    network.invoke()
    found = [network.get_tensor(one["index"]) for one in network.get_output_details()]
    return {str(values.shape): values for values in found}


def run_onnx(session: onnxruntime.InferenceSession, picture: np.ndarray) -> dict[str, np.ndarray]:
    """Outputs by shape."""
    return {str(tuple(v.shape)): v for v in session.run(None, {session.get_inputs()[0].name: picture})}


if __name__ == "__main__":
    main()
