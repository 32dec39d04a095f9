"""RF-DETR-Seg (Roboflow, COCO weights, ONNX): instances of things and people in one picture.

Tensor contract: input `input` (1, 3, S, S) float32, RGB in [0, 1] less the ImageNet mean over its deviation, the
picture stretched to the square (S is 312 nano, 384 small, 432 medium, 504 large); outputs `dets` (1, Q, 4), boxes, not
read here, `labels` (1, Q, 91), one logit per COCO category id (a sigmoid each, no softmax, no background), and `masks`
(1, Q, S/4, S/4), logits over the whole picture, positive inside. One query per object: nothing is suppressed.

Source: the model card of besit/rfdetr-onnx (exports of rfdetr 1.11.0) and `docs/exports/onnx.md` of
https://github.com/roboflow/rf-detr. Code and these weights Apache-2.0.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from video2anim.networks.depth_anything import to_pixel_values
from video2anim.networks.labels import COCO_SLOTS, scene_class
from video2anim.networks.network import Network, sigmoid
from video2anim.networks.segmentation import CLASSES, SeenInstance, Segmentation

SIDE_PX = 384
"""Side for an export that takes any."""
MIN_SCORE = 0.5


class RfDetrSeg:
    """Instance network, for slot `segment`. It knows no floor, wall or ceiling: they are `other`."""

    name = "rf-detr-seg-small"

    def __init__(self, path: Path, *, min_score: float = MIN_SCORE) -> None:
        """Load the weights.

        Raises:
            ModelMissingError: the file is no network of that contract.
        """
        self._network = Network(path, inputs=("input",), outputs=("labels", "masks"))
        self._min_score = min_score

    def segment(self, image: UInt8[np.ndarray, "height width 3"]) -> Segmentation:
        """Furniture and people at the picture's own size, best score first.

        Raises:
            ModelMissingError: the network's outputs are not those of the contract.
        """
        net_h, net_w = self._network.fixed_size("input") or (SIDE_PX, SIDE_PX)
        found = self._network.run({"input": to_pixel_values(image, net_h, net_w)}, ("labels", "masks"))
        labels, masks = found["labels"], found["masks"]
        self._network.expect_shape("labels", labels, (1, None, len(COCO_SLOTS)))
        self._network.expect_shape("masks", masks, (1, labels.shape[1], None, None))
        height, width = image.shape[:2]
        semantic = np.full((height, width), CLASSES.index("other"), np.uint8)
        instances = []
        for score, name, query in _kept(labels[0], self._min_score):
            logits = cv2.resize(masks[0, query], (width, height), interpolation=cv2.INTER_LINEAR)
            mask = logits > 0.0
            if mask.any():
                instances.append(SeenInstance(name, CLASSES[scene_class(name)], score, mask))
        for instance in reversed(instances):  # the surest is painted last
            semantic[instance.mask] = CLASSES.index(instance.kind)
        return Segmentation(semantic, tuple(instances))


def _kept(logits: Float[np.ndarray, "queries slots"], min_score: float) -> list[tuple[float, str, int]]:
    """Score, name and query of what is furniture or a person, best first."""
    scores = np.where(np.isfinite(logits), sigmoid(logits), 0.0)
    best = scores.argmax(axis=1)
    wanted = (CLASSES.index("furniture"), CLASSES.index("person"))
    kept = []
    for query, slot in enumerate(best):
        score, name = float(scores[query, slot]), COCO_SLOTS[slot]
        if score >= min_score and name is not None and scene_class(name) in wanted:
            kept.append((score, name, query))
    return sorted(kept, key=lambda entry: -entry[0])
