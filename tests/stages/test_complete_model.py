"""Stage complete with a network in place of geometry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from object_graphs import completer_file
from scene_chain import run_chain
from synthetic_room import make_room

from stages import complete
from stages.complete import CompleteConfig, complete_objects
from video2anim import networks
from video2anim.cli.compose import TableModels, pipeline_nodes
from video2anim.errors import ModelMissingError, UsageError
from video2anim.pipeline.config import resolve
from video2anim.pipeline.stage import StageContext
from video2anim.types import CompletedObjects, InstanceMasks, ObjectInstance

YES, GREEN = np.full((256, 256), 5.0), np.tile([0.0, 0.8, 0.2], (256, 256, 1))


def bitten(share: float) -> tuple[InstanceMasks, np.ndarray]:
    """The room's box with something nearer in front of a share of its columns, and those pixels."""
    masks = run_chain(make_room()).masks
    whole = masks.instances[0].mask
    rows, columns = np.nonzero(whole)
    bite = np.zeros_like(whole)
    right = columns.min() + round(share * (np.ptp(columns) + 1))
    bite[rows.max() - 15 : rows.max() + 60, columns.min() : right] = True
    if share > 0.5:
        bite[rows.min() - 2 : rows.max() + 3, columns.min() : right] = True
    front = ObjectInstance(2, "object", 1.0, np.zeros(4), bite)
    back = ObjectInstance(1, "object", 1.0, np.zeros(4), whole & ~bite)
    return InstanceMasks("test", (back, front), masks.floor_mask), bite


def completed(
    masks: InstanceMasks, model: str = "none", ctx: StageContext | None = None, **options: float
) -> CompletedObjects:
    room = make_room()
    ctx = ctx or context()
    return complete_objects(room.background, masks, run_chain(room).metric, CompleteConfig(model=model, **options), ctx)


def context() -> StageContext:
    return StageContext(Path(), load_model=networks.load_model)


def net(tmp_path: Path, logits: np.ndarray = YES, color: np.ndarray = GREEN) -> str:
    return f"completer@{completer_file(tmp_path / 'net.onnx', logits, color)}"


def test_the_network_says_outline_and_colors(tmp_path: Path) -> None:
    masks, bite = bitten(0.3)
    ctx = context()
    back, front = completed(masks, net(tmp_path), ctx, max_completed_ratio=0.9).objects
    own = completed(masks, max_completed_ratio=0.9).objects[0]
    seen = masks.instances[0].mask
    assert (back.amodal_mask[seen]).all()
    assert back.completed_ratio == pytest.approx(1 - seen.sum() / back.amodal_mask.sum())
    assert (back.amodal_mask & bite).sum() > (own.amodal_mask & bite).sum(), "more than convexity calls for"
    assert not back.amodal_mask[~seen & ~bite & ~unseen()].any(), "nothing but where it may be hidden"
    (x, y), (h, w) = back.crop_xy_px, back.image_rgb.shape[:2]
    window = (slice(y, y + h), slice(x, x + w))
    added = (back.amodal_mask & ~seen)[window]
    assert added.sum() > 100
    assert (back.image_rgb[added] == (0, 204, 51)).all()
    np.testing.assert_array_equal(back.image_rgb[seen[window]], make_room().background.background_rgb[seen])
    assert (back.image_rgb[~back.amodal_mask[window]] == 127).all()
    assert ctx.warnings == []
    np.testing.assert_array_equal(front.amodal_mask & bite, bite)


def unseen() -> np.ndarray:
    """Pixels of the background image that were hardly ever free of people, and those beside them."""
    import cv2

    background = make_room().background
    height, width = background.background_rgb.shape[:2]
    return cv2.resize(background.seen_ratio.astype(np.float32), (width, height)) < 0.02


def test_too_much_of_it_is_kept_out_as_before(tmp_path: Path) -> None:
    masks, _ = bitten(0.7)
    ctx = context()
    back = completed(masks, net(tmp_path), ctx).objects[0]
    np.testing.assert_array_equal(back.amodal_mask, masks.instances[0].mask)
    assert back.completed_ratio == 0.0
    assert not (back.image_rgb == (0, 204, 51)).all(-1).any()
    assert any("object 1 would be" in warning and "its visible part is kept" in warning for warning in ctx.warnings)


@pytest.mark.parametrize("name", ["amodal", "color"])
def test_an_answer_that_is_not_finite_leaves_it_to_geometry(tmp_path: Path, name: str) -> None:
    logits, color = YES.copy(), GREEN.copy()
    {"amodal": logits, "color": color}[name][0, 0] = np.nan
    masks, _ = bitten(0.3)
    ctx = context()
    made, own = completed(masks, net(tmp_path, logits, color), ctx), completed(masks)
    for one, other in zip(made.objects, own.objects, strict=True):
        np.testing.assert_array_equal(one.amodal_mask, other.amodal_mask)
        np.testing.assert_array_equal(one.image_rgb, other.image_rgb)
    assert own.objects[0].completed_ratio > 0
    assert len(ctx.warnings) == 2
    for number, warning in enumerate(ctx.warnings, 1):
        assert f"object {number} is completed by geometry instead: completer: want finite {name}" in warning
        assert "\n" not in warning


def test_wrong_networks_stop_the_stage(tmp_path: Path) -> None:
    masks, _ = bitten(0.3)
    with pytest.raises(ModelMissingError, match="want amodal"):
        completed(masks, net(tmp_path, YES[:9]))
    with pytest.raises(ModelMissingError, match="there is none; correct the path"):
        completed(masks, f"completer@{tmp_path / 'none.onnx'}")
    with pytest.raises(UsageError, match=r"complete\.model: want a model of slot completer"):
        resolve(pipeline_nodes(), "p", [("test", {"complete": {"model": f"lifter@{tmp_path / 'net.onnx'}"}})])


def test_the_file_is_part_of_the_key(tmp_path: Path) -> None:
    digests = TableModels().digests
    assert digests(complete.STAGE.models, CompleteConfig()) == {}
    found = [
        digests(complete.STAGE.models, CompleteConfig(model=net(tmp_path, logits)))["completer"]
        for logits in (YES, -YES, YES)
    ]
    assert found[0] == found[2] != found[1]
