"""The completer's adapter: what the network is shown, and where its answer lands in the picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from object_graphs import completer_file

from video2anim import networks
from video2anim.errors import ModelMissingError, StageError
from video2anim.networks.mask_completer import MaskCompleter, crop_of

HEIGHT, WIDTH = 160, 240
GRAY = 127 / 255
YES, GREEN = np.full((256, 256), 5.0), np.tile([0.0, 0.8, 0.2], (256, 256, 1))


def rectangle(top: int, bottom: int, left: int, right: int) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[top:bottom, left:right] = True
    return mask


SEEN = rectangle(60, 124, 100, 140)  # its crop: 128 pixels from row 28 and column 56, each two of the network's
HIDDEN = rectangle(60, 124, 120, 170)
PICTURE = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
PICTURE[..., 0] = 200
PICTURE[SEEN] = (10, 20, 250)


def net(tmp_path: Path, logits: np.ndarray = YES, color: np.ndarray = GREEN) -> MaskCompleter:
    return MaskCompleter(completer_file(tmp_path / "tiny.onnx", logits, color))


def shown(model: MaskCompleter, monkeypatch: pytest.MonkeyPatch, *what: np.ndarray) -> dict[str, np.ndarray]:
    """What the network is fed."""
    fed: list[dict[str, np.ndarray]] = []
    run = model._network.run
    monkeypatch.setattr(model._network, "run", lambda feeds, names: fed.append(dict(feeds)) or run(feeds, names))
    model.complete(*what)
    return fed[0]


def test_the_crop_is_twice_the_longer_side() -> None:
    assert crop_of(SEEN) == ((28, 56), 128)
    assert crop_of(rectangle(0, 10, 0, 90)) == ((-85, -45), 180)
    assert crop_of(rectangle(7, 8, 9, 10)) == ((-1, 1), 16), "a speck keeps surroundings"
    with pytest.raises(ValueError, match="want a mask with pixels"):
        crop_of(np.zeros((4, 4), bool))


def test_the_network_is_shown_picture_and_masks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fed = shown(net(tmp_path), monkeypatch, PICTURE, SEEN, HIDDEN)
    seen, hidden = np.zeros((256, 256)), np.zeros((256, 256))
    seen[64:192, 88:168] = 1
    hidden[64:192, 168:228] = 1  # what is seen is not hidden
    np.testing.assert_array_equal(fed["visible"], seen[None, None])
    np.testing.assert_array_equal(fed["hidden"], hidden[None, None])
    assert {name: (value.shape, value.dtype) for name, value in fed.items()} == {
        "picture": ((1, 3, 256, 256), np.float32),
        "visible": ((1, 1, 256, 256), np.float32),
        "hidden": ((1, 1, 256, 256), np.float32),
    }
    np.testing.assert_allclose(fed["picture"][0, :, 128, 128], np.array([10, 20, 250]) / 255, atol=1e-6)
    np.testing.assert_allclose(fed["picture"][0, :, 10, 10], [200 / 255, 0, 0], atol=1e-6)


def test_a_pixel_that_is_half_seen_is_not_hidden_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two pixels of the picture are one of the network's, and the border between seen and hidden halves one."""
    seen, hidden = np.zeros((2, 500, 600), bool)
    seen[100:356, 200:301] = True
    hidden[100:356, 301:350] = True
    fed = shown(net(tmp_path), monkeypatch, np.zeros((500, 600, 3), np.uint8), seen, hidden)
    row = 128
    assert np.flatnonzero(fed["visible"][0, 0, row]).tolist() == list(range(103, 154))
    assert np.flatnonzero(fed["hidden"][0, 0, row]).tolist() == list(range(154, 178))


def test_beyond_the_picture_is_gray_and_neither_seen_nor_hidden(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    corner = rectangle(0, 64, 0, 64)  # its crop: 128 pixels from row -32 and column -32
    fed = shown(net(tmp_path), monkeypatch, PICTURE, corner, np.ones_like(corner))
    np.testing.assert_allclose(fed["picture"][0, :, :63, :], GRAY, atol=1e-6)
    np.testing.assert_allclose(fed["picture"][0, :, :, :63], GRAY, atol=1e-6)
    assert fed["visible"][0, 0, 64:192, 64:192].all()
    assert fed["visible"].sum() == 128**2
    assert not fed["hidden"][0, 0, :64].any()
    assert not fed["hidden"][0, 0, :, :64].any()
    assert fed["hidden"][0, 0, 64:, 64:].sum() == 192**2 - 128**2


def test_only_what_may_be_hidden_is_added_in_the_networks_color(tmp_path: Path) -> None:
    found = net(tmp_path).complete(PICTURE, SEEN, HIDDEN)
    np.testing.assert_array_equal(found.amodal, SEEN | HIDDEN)
    assert (found.rgb[HIDDEN & ~SEEN] == (0, 204, 51)).all()
    np.testing.assert_array_equal(found.rgb[SEEN | ~HIDDEN], PICTURE[SEEN | ~HIDDEN])
    assert (PICTURE[HIDDEN & ~SEEN] == (200, 0, 0)).all(), "the picture that was given is left alone"


def test_the_answer_lands_where_it_belongs(tmp_path: Path) -> None:
    """A network's rectangle of rows 100 to 139 and columns 180 to 219 is rows 78 to 97, columns 146 to 165."""
    logits, color = np.full((256, 256), -5.0), np.zeros((256, 256, 3))
    logits[100:140, 180:220] = 5.0
    color[..., 0] = np.linspace(0, 1, 256)
    color[..., 1] = np.linspace(0, 1, 256)[:, None]
    found = net(tmp_path, logits, color).complete(PICTURE, SEEN, HIDDEN)
    added = rectangle(78, 98, 146, 166)
    np.testing.assert_array_equal(found.amodal, SEEN | added)
    rows, columns = np.nonzero(added)
    red, green = 255 * (2 * (columns - 56) + 0.5) / 255, 255 * (2 * (rows - 28) + 0.5) / 255
    np.testing.assert_allclose(found.rgb[added], np.stack([red, green, 0 * red], -1), atol=0.51)


def test_what_is_seen_stays_whatever_the_network_says(tmp_path: Path) -> None:
    found = net(tmp_path, -YES).complete(PICTURE, SEEN, HIDDEN)
    np.testing.assert_array_equal(found.amodal, SEEN)
    np.testing.assert_array_equal(found.rgb, PICTURE)


@pytest.mark.parametrize("where", [(0, 40, 0, 40), (120, 160, 200, 240), (0, 160, 0, 240), (40, 43, 10, 200)])
def test_any_place_and_size_is_completed(tmp_path: Path, where: tuple[int, int, int, int]) -> None:
    """At the border of the picture, as large as it, and thin; half of the box's longer side at each side is added."""
    seen = rectangle(*where)
    found = net(tmp_path).complete(PICTURE, seen, np.ones_like(seen))
    (top, left), side = crop_of(seen)
    shown = rectangle(max(0, top), top + side, max(0, left), left + side)
    np.testing.assert_array_equal(found.amodal, shown | seen)
    assert (found.rgb[shown & ~seen] == (0, 204, 51)).all()


def test_colors_are_held_to_their_range(tmp_path: Path) -> None:
    found = net(tmp_path, color=np.tile([-0.3, 1.4, 0.2], (256, 256, 1))).complete(PICTURE, SEEN, HIDDEN)
    assert (found.rgb[HIDDEN & ~SEEN] == (0, 255, 51)).all()


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["amodal", "color"])
def test_what_is_not_finite_is_no_answer(tmp_path: Path, name: str, value: float) -> None:
    logits, color = YES.copy(), GREEN.copy()
    {"amodal": logits, "color": color}[name][30, 40] = value
    with pytest.raises(StageError, match=rf"completer: want finite {name}, got") as caught:
        net(tmp_path, logits, color).complete(PICTURE, SEEN, HIDDEN)
    assert "\n" not in str(caught.value)


def test_other_shapes_and_tensors_are_refused(tmp_path: Path) -> None:
    for logits, color, told in (
        (YES[:128], GREEN, r"want amodal \(1, 1, 256, 256\), got \(1, 1, 128, 256\)"),
        (YES, GREEN[..., :1], r"want color \(1, 3, 256, 256\), got \(1, 1, 256, 256\)"),
    ):
        with pytest.raises(ModelMissingError, match=told):
            net(tmp_path, logits, color).complete(PICTURE, SEEN, HIDDEN)
    with pytest.raises(ModelMissingError, match=r"want an \.onnx network"):
        MaskCompleter(tmp_path / "none.onnx")


def test_table_loads_the_users_file(tmp_path: Path) -> None:
    path = completer_file(tmp_path / "mine.onnx", YES, GREEN)
    found = networks.load_model(f"completer@{path}").complete(PICTURE, SEEN, HIDDEN)
    np.testing.assert_array_equal(found.amodal, MaskCompleter(path).complete(PICTURE, SEEN, HIDDEN).amodal)
    assert list(networks.weight_digests(f"completer@{path}")) == ["completer"]
    assert networks.find_model("completer").slot == "completer"
    with pytest.raises(ModelMissingError, match="there is none; correct the path"):
        networks.load_model(f"completer@{tmp_path / 'none.onnx'}")
