"""Class names of the public segmentation networks, and the one table that turns them into the six scene classes.

Sources: the category list of COCO panoptic (80 things, then 53 kinds of stuff; category ids of the things have gaps),
and the 150 classes of ADE20K's scene parsing benchmark, both in the order the networks number them.
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
"""In contiguous order; `COCO_SLOTS` has them at their category ids."""
_UNUSED_IDS = (0, 12, 26, 29, 30, 45, 66, 68, 69, 71, 83)
COCO_SLOTS: tuple[str | None, ...] = tuple(
    None if slot in _UNUSED_IDS else COCO_THINGS[slot - sum(unused < slot for unused in _UNUSED_IDS)]
    for slot in range(91)
)
"""Name at each COCO category id, 0 to 90; None where there is no category."""
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
ADE20K = (
    "wall", "building", "sky", "floor", "tree", "ceiling", "road", "bed", "windowpane", "grass", "cabinet",
    "sidewalk", "person", "earth", "door", "table", "mountain", "plant", "curtain", "chair", "car", "water",
    "painting", "sofa", "shelf", "house", "sea", "mirror", "rug", "field", "armchair", "seat", "fence", "desk",
    "rock", "wardrobe", "lamp", "bathtub", "railing", "cushion", "base", "box", "column", "signboard",
    "chest of drawers", "counter", "sand", "sink", "skyscraper", "fireplace", "refrigerator", "grandstand", "path",
    "stairs", "runway", "case", "pool table", "pillow", "screen door", "stairway", "river", "bridge", "bookcase",
    "blind", "coffee table", "toilet", "flower", "book", "hill", "bench", "countertop", "stove", "palm",
    "kitchen island", "computer", "swivel chair", "boat", "bar", "arcade machine", "hovel", "bus", "towel", "light",
    "truck", "tower", "chandelier", "awning", "streetlight", "booth", "television receiver", "airplane", "dirt track",
    "apparel", "pole", "land", "bannister", "escalator", "ottoman", "bottle", "buffet", "poster", "stage", "van",
    "ship", "fountain", "conveyer belt", "canopy", "washer", "plaything", "swimming pool", "stool", "barrel",
    "basket", "waterfall", "tent", "bag", "minibike", "cradle", "oven", "ball", "food", "step", "tank", "trade name",
    "microwave", "pot", "animal", "bicycle", "lake", "dishwasher", "screen", "blanket", "sculpture", "hood", "sconce",
    "vase", "traffic light", "tray", "ashcan", "fan", "pier", "crt screen", "plate", "monitor", "bulletin board",
    "shower", "radiator", "glass", "clock", "flag",
)  # fmt: skip

SCENE_CLASS = {
    "floor": (  # what one walks on, rugs included
        "floor", "floor-wood", "floor-other-merged", "rug", "rug-merged", "road", "sidewalk", "pavement-merged", "path",
        "runway", "platform", "playingfield", "field", "grass", "grass-merged", "earth", "dirt-merged", "dirt track",
        "land", "sand", "gravel", "snow",
    ),
    "wall": (  # upright bounds of the place, with what is let into them or hangs flat before them
        "wall", "wall-brick", "wall-stone", "wall-tile", "wall-wood", "wall-other-merged", "door", "door-stuff",
        "screen door", "windowpane", "window-other", "window-blind", "blind", "curtain", "mirror", "mirror-stuff",
        "painting", "poster", "bulletin board", "building", "building-other-merged", "house", "column", "fence",
        "fence-merged",
    ),
    "ceiling": ("ceiling", "ceiling-merged"),
    "furniture": (  # stands on the floor, keeps still; a person sits or lies on it, leans on it or walks into it
        "chair", "armchair", "swivel chair", "seat", "stool", "ottoman", "bench", "sofa", "couch", "bed", "cradle",
        "table", "dining table", "table-merged", "coffee table", "pool table", "desk", "counter", "countertop",
        "kitchen island", "bar", "buffet", "cabinet", "cabinet-merged", "wardrobe", "chest of drawers", "shelf",
        "bookcase", "fireplace", "refrigerator", "oven", "stove", "washer", "dishwasher", "toilet", "bathtub",
        "radiator", "stairs", "stairway", "step", "bannister", "railing", "box", "barrel", "base", "stage",
        "arcade machine", "suitcase", "fire hydrant", "parking meter",
    ),
    "person": ("person",),
}  # fmt: skip
"""Scene class -> names of all vocabularies; a name in none is `other`: small objects that lie or hang somewhere (tv,
laptop, cushion, lamp, potted plants, most of which stand on something else), animals and vehicles, which move."""
_CLASS_OF = {name: CLASSES.index(kind) for kind, names in SCENE_CLASS.items() for name in names}


def scene_class(name: str | None) -> int:
    """Index into `segmentation.CLASSES` of a network's class name; `other` for names without a place in the table."""
    return _CLASS_OF.get(name or "", CLASSES.index("other"))
