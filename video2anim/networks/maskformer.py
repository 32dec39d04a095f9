"""Mask classification networks (EoMT, MaskFormer, Mask2Former; ONNX): scene classes and instances of one picture.

Tensor contract of all: input `pixel_values` (1, 3, H, W) float32, RGB in [0, 1] less the ImageNet mean over its
deviation, and in some exports `pixel_mask` (1, H, W), 1 where there is picture; outputs `class_queries_logits`
(1, Q, C + 1), a softmax over C classes and, last, no object, and `masks_queries_logits` (1, Q, h, w), logits over the
whole input. The number of classes tells the vocabulary: 133 COCO panoptic, 150 ADE20K.

- EoMT-S (Kerssies et al. 2025), COCO panoptic at 640: H = W = 640, Q = 200, h = w = 160; the longer side is brought to
  640 and the rest below or to the right is black. Source: the model card of jessolmstead/greycard-sky, an export of
  tue-mps/coco_panoptic_eomt_small_640_2x, and its preprocessor_config.json. MIT, the DINOv2 backbone Apache-2.0.
- MaskFormer and Mask2Former (Cheng et al. 2021, 2022), ADE20K or COCO panoptic: the shorter side is brought to 512 (the
  training size of the small ADE20K ones), both sides multiples of 32; an export of one size gets the picture stretched
  to it. Source: MODEL_ZOO.md of https://github.com/facebookresearch/MaskFormer and of Mask2Former, which put the
  weights under CC-BY-NC-4.0, and the preprocessor_config.json of facebook/mask2former-swin-small-ade-semantic. Of
  weights trained for classes only (ADE20K), all chairs of a picture may be one instance.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from video2anim.errors import ModelMissingError
from video2anim.networks.depth_anything import MEAN_RGB, STD_RGB, to_pixel_values
from video2anim.networks.labels import ADE20K, COCO_PANOPTIC, scene_class
from video2anim.networks.network import Network, sigmoid
from video2anim.networks.segmentation import CLASSES, SeenInstance, Segmentation

MULTIPLE_PX = 32
MIN_SCORE = 0.5
"""Class probability from which a query is a segment."""
MIN_OWN_RATIO = 0.5
"""A segment that keeps less of its mask than this against surer ones is a double of them."""
_VOCABULARIES = {len(names): names for names in (COCO_PANOPTIC, ADE20K)}
_MASK_TYPES = {
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
    "tensor(bool)": np.bool_,
    "tensor(float)": np.float32,
}


class MaskFormer:
    """MaskFormer or Mask2Former, for slot `segment`."""

    name = "maskformer-swin-small-ade"
    short_side_px, long_side_px = 512, 2048
    fixed_fit: Literal["stretch", "pad"] = "stretch"
    """How a picture gets into a network of one size."""

    def __init__(self, path: Path, *, min_score: float = MIN_SCORE) -> None:
        """Load the weights.

        Raises:
            ModelMissingError: the file is no network of that contract.
        """
        self._network = Network(
            path,
            inputs=("pixel_values",),
            optional_inputs=("pixel_mask",),
            outputs=("class_queries_logits", "masks_queries_logits"),
        )
        self._min_score = min_score

    def segment(self, image: UInt8[np.ndarray, "height width 3"]) -> Segmentation:
        """Scene classes, and the instances of furniture and people, at the picture's own size.

        Raises:
            ModelMissingError: the network's outputs are not those of the contract.
        """
        pixel_values, shown = self._input(image)
        net = pixel_values.shape[2:]
        feeds: dict[str, np.ndarray] = {"pixel_values": pixel_values}
        if "pixel_mask" in self._network.inputs:
            mask_type = _MASK_TYPES.get(self._network.inputs["pixel_mask"].type, np.int64)
            feeds["pixel_mask"] = np.zeros((1, *net), mask_type)
            feeds["pixel_mask"][:, : shown[0], : shown[1]] = 1
        found = self._network.run(feeds, ("class_queries_logits", "masks_queries_logits"))
        logits, masks = found["class_queries_logits"], found["masks_queries_logits"]
        self._network.expect_shape("class_queries_logits", logits, (1, None, None))
        self._network.expect_shape("masks_queries_logits", masks, (1, logits.shape[1], None, None))
        names = _VOCABULARIES.get(logits.shape[2] - 1)
        if names is None:
            raise ModelMissingError(
                f"{self._network.path}: want class_queries_logits of 133 (COCO panoptic) or 150 (ADE20K) classes and "
                f"no object, got {logits.shape[2]} logits"
            )
        # Pixels of the masks that lie over the picture; the rest lies over padding.
        ratio = (shown[0] / net[0], shown[1] / net[1])
        probability = _softmax(logits[0])[:, :-1]
        semantic = _semantic(probability, masks[0], names, ratio, image.shape[:2])
        return Segmentation(semantic, self._instances(probability, masks[0], names, ratio, image.shape[:2]))

    def _input(
        self, image: UInt8[np.ndarray, "height width 3"]
    ) -> tuple[Float[np.ndarray, "1 3 net_height net_width"], tuple[int, int]]:
        """What the network is shown, and the height and width of the picture in it."""
        height, width = image.shape[:2]
        fixed = self._network.fixed_size("pixel_values")
        if fixed is None:
            scale = min(self.short_side_px / min(height, width), self.long_side_px / max(height, width))
            net_h, net_w = (
                max(MULTIPLE_PX, round(side * scale / MULTIPLE_PX) * MULTIPLE_PX) for side in (height, width)
            )
            return to_pixel_values(image, net_h, net_w), (net_h, net_w)
        if self.fixed_fit == "stretch":
            return to_pixel_values(image, *fixed), fixed
        scale = min(fixed[0] / height, fixed[1] / width)
        shown = (max(1, min(fixed[0], round(height * scale))), max(1, min(fixed[1], round(width * scale))))
        black = (-np.array(MEAN_RGB, np.float32) / np.array(STD_RGB, np.float32))[None, :, None, None]
        values = np.repeat(np.repeat(black, fixed[0], axis=2), fixed[1], axis=3)
        values[:, :, : shown[0], : shown[1]] = to_pixel_values(image, *shown)
        return values, shown

    def _instances(
        self,
        probability: Float[np.ndarray, "queries classes"],
        masks: Float[np.ndarray, "queries mask_height mask_width"],
        names: tuple[str, ...],
        ratio: tuple[float, float],
        size: tuple[int, ...],
    ) -> tuple[SeenInstance, ...]:
        """Each pixel goes to the segment with the largest product of class and mask probability."""
        best, owner = np.zeros(size, np.float32), np.full(size, -1, np.int32)
        inside: dict[int, Bool[np.ndarray, "height width"]] = {}
        wanted = (CLASSES.index("furniture"), CLASSES.index("person"))
        scores, classes = probability.max(axis=1), probability.argmax(axis=1)
        for query in np.flatnonzero(scores >= self._min_score):
            logits = _at_size(masks[query], ratio, size)
            likely = scores[query] * sigmoid(logits)
            won = likely > best
            best[won], owner[won] = likely[won], query
            if scene_class(names[classes[query]]) in wanted:
                inside[int(query)] = logits > 0.0
        instances = []
        for query, mask in inside.items():
            own = mask & (owner == query)
            if own.any() and own.sum() >= MIN_OWN_RATIO * mask.sum():
                name = names[classes[query]]
                instances.append(SeenInstance(name, CLASSES[scene_class(name)], float(scores[query]), own))
        return tuple(sorted(instances, key=lambda instance: -instance.score))


class Eomt(MaskFormer):
    """EoMT at one size, the picture padded to it, for slot `segment`."""

    name = "eomt-small-coco"
    fixed_fit = "pad"


def _semantic(
    probability: Float[np.ndarray, "queries classes"],
    masks: Float[np.ndarray, "queries mask_height mask_width"],
    names: tuple[str, ...],
    ratio: tuple[float, float],
    size: tuple[int, ...],
) -> UInt8[np.ndarray, "height width"]:
    """The scene class with the largest sum, over queries and its network classes, of class and mask probability.

    Of `other` only the likeliest network class counts: it is many unlike objects, whose small shares would add up.
    """
    each = np.tensordot(probability.T, sigmoid(masks), axes=1)
    scene = np.array([scene_class(name) for name in names])
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
