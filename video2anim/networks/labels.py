"""Class names of COCO panoptic, and the one table that turns them into the six scene classes.

Source: its category list (80 things, then 53 kinds of stuff), in the order the networks number them.
"""

from __future__ import annotations

from video2anim.networks.segmentation import CLASSES

COCO_THINGS = (
    "person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat", "traffic light",
    "fire hydrant", "stop sign", "parking meter", "bench", "bird", "cat", "dog", "horse", "sheep", "cow", "elephant",
    "bear", "zebra", "giraffe", "backpack", "umbrella", "handbag", "tie", "suitcase", "frisbee", "skis", "snowboard",
    "sports ball", "kite", "baseball bat", "baseball glove", "skateboard", "surfboard", "tennis racket", "bottle",
    "wine glass", "cup", "fork", "knife", "spoon", "bowl", "banana", "apple", "sandwich", "orange", "broccoli",
    "carrot", "hot dog", "pizza", "donut", "cake", "chair", "couch", "potted plant", "bed", "dining table", "toilet",
    "tv", "laptop", "mouse", "remote", "keyboard", "cell phone", "microwave", "oven", "toaster", "sink",
    "refrigerator", "book", "clock", "vase", "scissors", "teddy bear", "hair drier", "toothbrush",
)  # fmt: skip
COCO_STUFF = (
    "banner", "blanket", "bridge", "cardboard", "counter", "curtain", "door-stuff", "floor-wood", "flower", "fruit",
    "gravel", "house", "light", "mirror-stuff", "net", "pillow", "platform", "playingfield", "railroad", "river",
    "road", "roof", "sand", "sea", "shelf", "snow", "stairs", "tent", "towel", "wall-brick", "wall-stone",
    "wall-tile", "wall-wood", "water-other", "window-blind", "window-other", "tree-merged", "fence-merged",
    "ceiling-merged", "sky-other-merged", "cabinet-merged", "table-merged", "floor-other-merged", "pavement-merged",
    "mountain-merged", "grass-merged", "dirt-merged", "paper-merged", "food-other-merged", "building-other-merged",
    "rock-merged", "wall-other-merged", "rug-merged",
)  # fmt: skip
COCO_PANOPTIC = COCO_THINGS + COCO_STUFF

SCENE_CLASS = {
    "floor": (  # what one walks on, rugs included
        "floor-wood", "floor-other-merged", "rug-merged", "road", "pavement-merged", "platform", "playingfield",
        "grass-merged", "dirt-merged", "sand", "gravel", "snow",
    ),
    "wall": (  # upright bounds of the place, with what is let into them or hangs flat before them
        "wall-brick", "wall-stone", "wall-tile", "wall-wood", "wall-other-merged", "door-stuff", "window-other",
        "window-blind", "curtain", "mirror-stuff", "building-other-merged", "house", "fence-merged",
    ),
    "ceiling": ("ceiling-merged",),
    "furniture": (  # stands on the floor, keeps still; a person sits or lies on it, leans on it or walks into it
        "chair", "bench", "couch", "bed", "dining table", "table-merged", "counter", "cabinet-merged", "shelf",
        "refrigerator", "oven", "toilet", "stairs", "suitcase", "fire hydrant", "parking meter",
    ),
    "person": ("person",),
}  # fmt: skip
"""Scene class -> names; a name in none is `other`: small objects that lie or hang somewhere (tv, laptop, pillow, light,
potted plants, most of which stand on something else), animals and vehicles, which move."""
_CLASS_OF = {name: CLASSES.index(kind) for kind, names in SCENE_CLASS.items() for name in names}


def scene_class(name: str) -> int:
    """Index into `segmentation.CLASSES` of a network's class name; `other` for names without a place in the table."""
    return _CLASS_OF.get(name, CLASSES.index("other"))
