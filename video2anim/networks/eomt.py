"""EoMT (Kerssies et al. 2025; ONNX): scene classes and instances of one picture by mask classification.

Tensor contract: input `pixel_values` (1, 3, H, W) float32, RGB in [0, 1] less the ImageNet mean over its deviation,
H = W = 640; outputs `class_queries_logits` (1, Q, 134), a softmax over the 133 classes of COCO panoptic and, last, no
object, and `masks_queries_logits` (1, Q, h, w), logits over the whole input. Q = 200, h = w = 160. The picture's longer
side is brought to 640 and the rest below or to the right is black. Source: the model card of
jessolmstead/greycard-sky, an export of tue-mps/coco_panoptic_eomt_small_640_2x, and its preprocessor_config.json. MIT,
the DINOv2 backbone Apache-2.0.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from video2anim.networks.labels import COCO_PANOPTIC, scene_class
from video2anim.networks.network import Network, sigmoid
from video2anim.networks.segmentation import CLASSES, SeenInstance, Segmentation

MEAN_RGB = np.array((0.485, 0.456, 0.406), np.float32)
STD_RGB = np.array((0.229, 0.224, 0.225), np.float32)
SIDE_PX = 640
"""Side for an export that takes any."""
MIN_SCORE = 0.5
"""Class probability from which a query is a segment."""
MIN_OWN_RATIO = 0.5
"""A segment that keeps less of its mask than this against surer ones is a double of them."""


class Eomt:
    """The panoptic network, for slot `segment`."""

    name = "eomt-small-coco"

    def __init__(self, path: Path) -> None:
        """Load the weights.

        Raises:
            ModelMissingError: the file is no network of that contract.
        """
        self._network = Network(
            path,
            inputs=("pixel_values",),
            outputs=("class_queries_logits", "masks_queries_logits"),
        )

    def segment(self, image: UInt8[np.ndarray, "height width 3"]) -> Segmentation:
        """Scene classes, and the instances of furniture and people, at the picture's own size.

        Raises:
            ModelMissingError: the network's outputs are not those of the contract.
        """
        pixel_values, shown = self._input(image)
        net = pixel_values.shape[2:]
        found = self._network.run({"pixel_values": pixel_values}, ("class_queries_logits", "masks_queries_logits"))
        logits, masks = found["class_queries_logits"], found["masks_queries_logits"]
        self._network.expect_shape("class_queries_logits", logits, (1, None, len(COCO_PANOPTIC) + 1))
        self._network.expect_shape("masks_queries_logits", masks, (1, logits.shape[1], None, None))
        # Pixels of the masks that lie over the picture; the rest lies over padding.
        ratio = (shown[0] / net[0], shown[1] / net[1])
        probability = _softmax(logits[0])[:, :-1]
        semantic = _semantic(probability, masks[0], ratio, image.shape[:2])
        return Segmentation(semantic, self._instances(probability, masks[0], ratio, image.shape[:2]))

    def _input(
        self, image: UInt8[np.ndarray, "height width 3"]
    ) -> tuple[Float[np.ndarray, "1 3 net_height net_width"], tuple[int, int]]:
        """What the network is shown, and the height and width of the picture in it."""
        height, width = image.shape[:2]
        net_h, net_w = self._network.fixed_size("pixel_values") or (SIDE_PX, SIDE_PX)
        scale = min(net_h / height, net_w / width)
        shown = (max(1, min(net_h, round(height * scale))), max(1, min(net_w, round(width * scale))))
        black = (-MEAN_RGB / STD_RGB)[None, :, None, None]
        values = np.repeat(np.repeat(black, net_h, axis=2), net_w, axis=3)
        values[:, :, : shown[0], : shown[1]] = to_pixel_values(image, *shown)
        return values, shown

    def _instances(
        self,
        probability: Float[np.ndarray, "queries classes"],
        masks: Float[np.ndarray, "queries mask_height mask_width"],
        ratio: tuple[float, float],
        size: tuple[int, ...],
    ) -> tuple[SeenInstance, ...]:
        """Each pixel goes to the segment with the largest product of class and mask probability."""
        best, owner = np.zeros(size, np.float32), np.full(size, -1, np.int32)
        inside: dict[int, Bool[np.ndarray, "height width"]] = {}
        wanted = (CLASSES.index("furniture"), CLASSES.index("person"))
        scores, classes = probability.max(axis=1), probability.argmax(axis=1)
        for query in np.flatnonzero(scores >= MIN_SCORE):
            logits = _at_size(masks[query], ratio, size)
            likely = scores[query] * sigmoid(logits)
            won = likely > best
            best[won], owner[won] = likely[won], query
            if scene_class(COCO_PANOPTIC[classes[query]]) in wanted:
                inside[int(query)] = logits > 0.0
        instances = []
        for query, mask in inside.items():
            own = mask & (owner == query)
            if own.any() and own.sum() >= MIN_OWN_RATIO * mask.sum():
                name = COCO_PANOPTIC[classes[query]]
                instances.append(SeenInstance(name, CLASSES[scene_class(name)], float(scores[query]), own))
        return tuple(sorted(instances, key=lambda instance: -instance.score))


def to_pixel_values(
    image: UInt8[np.ndarray, "height width 3"], net_height: int, net_width: int
) -> Float[np.ndarray, "1 3 net_height net_width"]:
    """Resize (areas when shrinking, cubic when growing), scale to [0, 1], normalize, channels first."""
    grows = net_width > image.shape[1]
    resized = cv2.resize(image, (net_width, net_height), interpolation=cv2.INTER_CUBIC if grows else cv2.INTER_AREA)
    normal = (resized.astype(np.float32) / 255.0 - MEAN_RGB) / STD_RGB
    return np.ascontiguousarray(normal.transpose(2, 0, 1)[None])


def _semantic(
    probability: Float[np.ndarray, "queries classes"],
    masks: Float[np.ndarray, "queries mask_height mask_width"],
    ratio: tuple[float, float],
    size: tuple[int, ...],
) -> UInt8[np.ndarray, "height width"]:
    """The scene class with the largest sum, over queries and its network classes, of class and mask probability.

    Of `other` only the likeliest network class counts: it is many unlike objects, whose small shares would add up.
    """
    each = np.tensordot(probability.T, sigmoid(masks), axes=1)
    scene = np.array([scene_class(name) for name in COCO_PANOPTIC])
    shares = [each[scene == kind].sum(axis=0) for kind in range(len(CLASSES))]
    shares[CLASSES.index("other")] = each[scene == CLASSES.index("other")].max(axis=0)
    whole = np.stack([_at_size(share, ratio, size) for share in shares])
    return whole.argmax(axis=0).astype(np.uint8)


def _at_size(
    plane: Float[np.ndarray, "mask_height mask_width"], ratio: tuple[float, float], size: tuple[int, ...]
) -> Float[np.ndarray, "height width"]:
    """The part of a mask over the picture at the picture's size, pixels' areas (not their centers) in line."""
    step_y, step_x = ratio[0] * plane.shape[0] / size[0], ratio[1] * plane.shape[1] / size[1]
    from_picture = np.array([[step_x, 0.0, 0.5 * step_x - 0.5], [0.0, step_y, 0.5 * step_y - 0.5]])
    return cv2.warpAffine(
        np.ascontiguousarray(plane, np.float32),
        from_picture,
        (size[1], size[0]),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )


def _softmax(logits: Float[np.ndarray, "queries classes"]) -> Float[np.ndarray, "queries classes"]:
    raised = np.exp(logits - logits.max(axis=1, keepdims=True))
    return raised / raised.sum(axis=1, keepdims=True)
