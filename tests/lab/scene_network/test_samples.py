"""Training samples from small shards whose room is known by formula."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.optimize import fsolve

from video2anim.errors import InputError
from video2anim.geometry.perspective_field import PerspectiveField, fit_camera
from video2anim.lab.scene_network import samples
from video2anim.lab.scene_network.degrade import compressed, degraded, turned_hue
from video2anim.lab.scene_network.samples import CLASS_TABLE, PictureBatch, PictureShards, instance_targets
from video2anim.lab.synth.world import LABELS
from video2anim.networks.segmentation import CLASSES

HEIGHT, WIDTH, CAMERA_HEIGHT_M = 64, 96, 1.4
FOCAL_PX = (70.0, 48.0)
PITCH_DEG, ROLL_DEG = (-14.0, -24.0), (7.0, -5.0)
FLOOR, BOX, PERSON = 1, 7, 1000
"""Instance numbers."""
COLORS = {0: (150, 180, 220), FLOOR: (40, 160, 60), BOX: (200, 50, 40), PERSON: (60, 60, 210)}
NAMES = {0: "none", FLOOR: "floor", BOX: "box", PERSON: "person"}
SEEN_CLASS = {0: "other", FLOOR: "floor", BOX: "furniture", PERSON: "person"}


def rotation(pitch_deg: float, roll_deg: float) -> np.ndarray:
    """Axes of the camera in a world of x right, y up, looking along -z; turned up, then clockwise."""
    p, r = np.deg2rad(pitch_deg), np.deg2rad(roll_deg)
    nod = np.array([[1, 0, 0], [0, np.cos(p), -np.sin(p)], [0, np.sin(p), np.cos(p)]])
    turn = np.array([[np.cos(r), -np.sin(r), 0], [np.sin(r), np.cos(r), 0], [0, 0, 1]])
    return np.diag([1.0, -1.0, -1.0]) @ nod @ turn


def rendered(number: int) -> dict[str, np.ndarray]:
    """An endless floor under the sky, a box on it, and a flat person before it."""
    focal_px, R = FOCAL_PX[number], rotation(PITCH_DEG[number], ROLL_DEG[number])
    u, v = np.meshgrid(np.arange(WIDTH) - (WIDTH - 1) / 2, np.arange(HEIGHT) - (HEIGHT - 1) / 2)
    ray = np.stack([u / focal_px, v / focal_px, np.ones_like(u)], -1) @ R.T
    eye = np.array([0.0, CAMERA_HEIGHT_M, 0.0])
    depth_m, normal, instance = np.full(u.shape, np.inf), np.zeros((*u.shape, 3)), np.zeros(u.shape, np.uint16)

    def put(hit_m: np.ndarray, direction: np.ndarray, what: int) -> None:
        nearer = (hit_m > 0) & (hit_m < depth_m)
        depth_m[nearer], instance[nearer] = hit_m[nearer], what
        normal[nearer] = np.broadcast_to(direction, normal.shape)[nearer]

    with np.errstate(divide="ignore", invalid="ignore"):
        floor = -CAMERA_HEIGHT_M / ray[..., 1]
        put(np.where(floor < 40, floor, np.inf), np.array([0.0, 1.0, 0.0]), FLOOR)
        center, half = np.array([0.5, 0.4, -3.4]), np.array([0.5, 0.4, 0.35])
        near, far = np.sort(np.stack([(center - half - eye) / ray, (center + half - eye) / ray]), axis=0)
        enter, axis = near.max(-1), near.argmax(-1)
        facing = -np.sign(np.take_along_axis(ray, axis[..., None], -1)) * np.eye(3)[axis]
        put(np.where(enter < far.min(-1), enter, np.inf), facing, BOX)
        panel = -2.6 / ray[..., 2]
        spot = eye + ray * panel[..., None]
        on = (spot[..., 0] > -0.9) & (spot[..., 0] < -0.4) & (spot[..., 1] > 0) & (spot[..., 1] < 1.6)
        put(np.where(on, panel, np.inf), np.array([0.0, 0.0, 1.0]), PERSON)
    seen = np.isfinite(depth_m)
    return {
        "rgb": np.array([COLORS[int(i)] for i in instance.ravel()], np.uint8).reshape(HEIGHT, WIDTH, 3),
        "depth_mm": np.rint(np.where(seen, 1000 * depth_m, 0)).astype(np.uint16),
        "normal_camera": np.rint(127 * normal @ R).astype(np.int8),
        "instance": instance,
        "label": np.array([LABELS.index(NAMES[int(i)]) for i in instance.ravel()], np.uint8).reshape(instance.shape),
        "intrinsics": np.array([focal_px, focal_px, (WIDTH - 1) / 2, (HEIGHT - 1) / 2], np.float32),
        "distortion": np.zeros(2, np.float32),
        "up_camera": R[1].astype(np.float32),
        "camera_height_m": np.array(CAMERA_HEIGHT_M, np.float32),
    }


def write_shards(folder: Path, *, number: int = 0, **changed: np.ndarray) -> Path:
    """A shard of both pictures in the format of `video2anim.lab.synth.frames`; `changed` replaces whole arrays."""
    shard = folder / f"shard_{number:05d}"
    shard.mkdir(parents=True)
    pictures = [rendered(0), rendered(1)]
    for name in pictures[0]:
        values = changed.get(name, np.stack([picture[name] for picture in pictures]))
        np.save(shard / f"{name}.npy", values, allow_pickle=False)
    meta = {"format_version": 2, "pictures": 2, "width_px": WIDTH, "height_px": HEIGHT, "labels": list(LABELS)}
    (shard / "meta.json").write_text(json.dumps(meta))
    return folder


@pytest.fixture
def shards(tmp_path: Path) -> PictureShards:
    return PictureShards([write_shards(tmp_path / "set")], seed=3)


@pytest.fixture
def undegraded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(samples, "degraded", lambda picture, random: picture)


def palette_class(picture: torch.Tensor) -> np.ndarray:
    """Class of the nearest color at half size."""
    rgb = picture.numpy().reshape(3, picture.shape[1] // 2, 2, picture.shape[2] // 2, 2).mean((2, 4))
    far = np.stack([np.abs(rgb - np.array(color)[:, None, None]).sum(0) for color in COLORS.values()])
    return np.array([CLASSES.index(name) for name in SEEN_CLASS.values()])[far.argmin(0)]


def coded_camera(batch: PictureBatch, row: int) -> tuple[float, np.ndarray]:
    """Focal length in picture heights and up, as they follow from a sample's camera targets."""
    up, latitude = batch.up[row].numpy().transpose(1, 2, 0), batch.latitude[row].numpy()
    sigma = np.full(latitude.shape, 0.01)
    aspect = batch.picture.shape[3] / batch.picture.shape[2]
    found = fit_camera([PerspectiveField(up.astype(float), latitude.astype(float), sigma, sigma)], aspect)
    return found.focal_ratio, found.up_camera


def test_class_table_by_hand() -> None:
    wanted = {
        "floor": ["floor", "rug"],
        "wall": ["wall", "door", "window", "picture", "skirting"],
        "ceiling": ["ceiling"],
        "person": ["person"],
        "furniture": ["chair", "armchair", "sofa", "bed", "table", "desk", "shelf", "cabinet", "stool", "box", "step",
                      "mesh"],
        "other": ["none", "lamp", "book", "cup", "vase", "toy", "cushion", "monitor", "bag", "clutter"],
    }  # fmt: skip
    assert CLASS_TABLE.shape == (len(LABELS),)
    for kind, labels in wanted.items():
        for label in labels:
            assert CLASSES[CLASS_TABLE[LABELS.index(label)]] == kind, label


@pytest.mark.parametrize("number", [0, 1])
def test_labels_are_those_of_the_pixels_below(shards: PictureShards, number: int) -> None:
    """At the shard's own size: each label is that of one of its four pixels, and the picture is untouched."""
    truth, batch = rendered(number), shards.plain([number], (HEIGHT, WIDTH))
    np.testing.assert_array_equal(batch.picture[0].numpy(), truth["rgb"].transpose(2, 0, 1))
    assert batch.picture.dtype == torch.float32

    def blocks(values: np.ndarray) -> np.ndarray:
        return values.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, -1).transpose(0, 2, 1, 3, 4).reshape(32, 48, 4, -1)

    depth_m = np.where(truth["depth_mm"] > 0, truth["depth_mm"] / 1000, np.inf)
    classes = np.array([CLASSES.index(SEEN_CLASS[int(i)]) for i in truth["instance"].ravel()])
    normal = truth["normal_camera"] / np.maximum(np.linalg.norm(truth["normal_camera"], axis=-1, keepdims=True), 1)
    for found, whole in (
        (batch.disparity[0].numpy()[..., None], 1 / depth_m),
        (batch.normal[0].numpy().transpose(1, 2, 0), normal),
        (batch.classes[0].numpy()[..., None], classes),
    ):
        near = np.abs(blocks(whole) - found[:, :, None]).max(-1).min(-1)
        assert near.max() < 1e-5
    sky = batch.disparity[0] == 0
    assert 0.05 < sky.float().mean() < 0.6
    assert (batch.normal[0][:, sky] == 0).all()
    assert (batch.classes[0][sky] == CLASSES.index("other")).all()


def test_another_size_is_a_centered_crop(shards: PictureShards) -> None:
    """64 x 64 of 64 x 96: 16 columns off each side. 32 x 48: everything at half the size."""
    whole = shards.plain([0, 1], (HEIGHT, WIDTH))
    square = shards.plain([0, 1], (64, 64))
    torch.testing.assert_close(square.picture, whole.picture[..., 16:80])
    torch.testing.assert_close(square.disparity, whole.disparity[..., 8:40])
    torch.testing.assert_close(square.latitude, whole.latitude[..., 2:10])
    small = shards.plain([0, 1], (32, 48))
    assert small.picture.shape == (2, 3, 32, 48)
    assert small.disparity.shape == (2, 16, 24)
    assert small.up.shape == (2, 2, 4, 6)
    same = (palette_class(small.picture[0]) == small.classes[0].numpy()).mean()
    assert same > 0.9, "but for edges"


@pytest.mark.parametrize(("k1", "k2"), [(0.0, 0.0), (-0.1, 0.02)])
@pytest.mark.parametrize("size", [(64, 96), (64, 64), (32, 96)])
def test_camera_targets_by_brute_force(tmp_path: Path, size: tuple[int, int], k1: float, k2: float) -> None:
    """Rays by inverting the lens numerically, up by a raised point's ideal image; principal point off the middle."""
    truth = rendered(0)
    lens = np.array([[75.0, 70.0, 40.0, 36.0]] * 2, np.float32)
    folder = write_shards(tmp_path / "set", intrinsics=lens, distortion=np.array([[k1, k2]] * 2, np.float32))
    batch = PictureShards([folder]).plain([0], size)
    up = truth["up_camera"].astype(float)
    # The largest crop of the ratio, about the middle.
    ratio = size[1] / size[0]
    height = min(HEIGHT, WIDTH / ratio)
    width = height * ratio
    rows, columns = size[0] // 8, size[1] // 8
    assert batch.up.shape == (1, 2, rows, columns)
    for row in range(rows):
        for column in range(columns):
            # Pixel (0, 0) is the center of the top-left pixel, whose corner is at -0.5.
            u = (WIDTH - width) / 2 + (column + 0.5) * width / columns - 0.5
            v = (HEIGHT - height) / 2 + (row + 0.5) * height / rows - 0.5
            seen = np.array([(u - 40.0) / 75.0, (v - 36.0) / 70.0])

            def miss(ideal: np.ndarray, seen: np.ndarray = seen) -> np.ndarray:
                r2 = ideal @ ideal
                return ideal * (1 + k1 * r2 + k2 * r2 * r2) - seen

            ray = np.append(np.asarray(fsolve(miss, seen, xtol=1e-12)), 1.0)
            rise = float(ray @ up)
            latitude = np.arctan2(rise, np.linalg.norm(ray - rise * up))
            assert float(batch.latitude[0, row, column]) == pytest.approx(latitude, abs=1e-5)
            raised = ray + 1e-6 * up
            moved = raised[:2] / raised[2] - ray[:2]
            np.testing.assert_allclose(batch.up[0, :, row, column], moved / np.linalg.norm(moved), atol=1e-4)


@pytest.mark.parametrize("size", [(64, 96), (64, 64), (96, 64)])
def test_crops_and_flips_keep_depth_camera_and_picture_together(
    shards: PictureShards, undegraded: None, size: tuple[int, int]
) -> None:
    """Camera targets alone predict disparity and normals of the floor; colors alone predict the classes."""
    batch = shards.batch(0, 24, size)
    rows, columns = size[0] // 2, size[1] // 2
    flipped, longer = [], []
    for row in range(24):
        focal_ratio, up = coded_camera(batch, row)
        x = ((np.arange(columns) + 0.5) / columns - 0.5) * size[1] / size[0] / focal_ratio
        y = ((np.arange(rows) + 0.5) / rows - 0.5) / focal_ratio
        x, y = np.meshgrid(x, y)
        predicted = -(x * up[0] + y * up[1] + up[2]) / CAMERA_HEIGHT_M
        floor = batch.classes[row].numpy() == CLASSES.index("floor")
        # A pixel's row may be off by half of one: 0.4 m at 20 m, little nearby.
        near = floor & (predicted > 0.2)
        assert near.sum() > 100
        assert np.abs(batch.disparity[row].numpy()[near] - predicted[near]).max() < 0.03
        normal = batch.normal[row].numpy()[:, floor]
        np.testing.assert_allclose(normal, np.broadcast_to(up[:, None], normal.shape), atol=0.012)
        assert (palette_class(batch.picture[row]) == batch.classes[row].numpy()).mean() > 0.94
        original = min((0, 1), key=lambda n: abs(up[2] - np.sin(np.deg2rad(PITCH_DEG[n]))))
        true_up = rotation(PITCH_DEG[original], ROLL_DEG[original])[1]
        np.testing.assert_allclose(np.abs(up), np.abs(true_up), atol=1e-3)
        flipped.append(up[0] * true_up[0] < 0)
        cropped_height = min(HEIGHT, WIDTH * size[0] / size[1])
        longer.append(focal_ratio / (FOCAL_PX[original] / cropped_height))
    assert 5 < sum(flipped) < 19, "about half are mirrored"
    assert min(longer) > 0.999, "never more than the picture"
    assert max(longer) < 1 / 0.7
    assert max(longer) - min(longer) > 0.15, "some are crops"


def test_offsets_are_of_the_flipped_picture_too(shards: PictureShards, undegraded: None) -> None:
    """Every known pixel's offset leads to the mean of its own instance, which is the box alone."""
    batch = shards.batch(1, 12, (64, 96))
    assert len({float(heat.argmax()) for heat in batch.heat}) > 3
    for row in range(12):
        known = batch.has_offset[row].numpy() > 0
        assert (batch.classes[row].numpy()[known] == CLASSES.index("furniture")).all()
        if not known.any():
            continue
        y, x = np.nonzero(known)
        goal = np.stack([x, y]) + 32 * batch.offset[row].numpy()[:, known]
        np.testing.assert_allclose(goal, np.broadcast_to([[x.mean()], [y.mean()]], goal.shape), atol=1e-3)
        peak = np.unravel_index(int(batch.heat[row].argmax()), batch.heat[row].shape)
        assert np.hypot(peak[0] - y.mean(), peak[1] - x.mean()) < 0.75


def targets(parts: list[tuple[int, tuple[slice, slice], str]]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Targets of a 40 x 60 picture of a floor with numbered parts, of which furniture and people are told apart."""
    instance, classes = np.zeros((40, 60), np.int64), np.full((40, 60), CLASSES.index("floor"))
    for number, place, kind in parts:
        instance[place], classes[place] = number, CLASSES.index(kind)
    found = instance_targets(torch.tensor(instance)[None], torch.tensor(classes)[None])
    return instance, {name: value[0].numpy() for name, value in found.items()}


def test_instance_targets_by_hand() -> None:
    """A chair (5) and a table (6) that touch, a person (7) on the floor, a cup-sized object (9), and a wall."""
    instance, found = targets([
        (0, (slice(0, 8), slice(0, 60)), "wall"),
        (5, (slice(10, 20), slice(10, 20)), "furniture"),
        (6, (slice(10, 20), slice(20, 41)), "furniture"),
        (9, (slice(30, 32), slice(50, 53)), "furniture"),
        (7, (slice(25, 35), slice(5, 9)), "person"),
    ])  # fmt: skip
    known = np.isin(instance, (5, 6))
    np.testing.assert_array_equal(found["has_offset"], known)  # 6 pixels of 2400 are less than 0.3 %
    np.testing.assert_array_equal(found["instance"], np.where(known, instance, 0))
    # Middles: (x, y) = (14.5, 14.5) and (30, 14.5); heights are 40 pixels.
    np.testing.assert_allclose(found["offset"][:, 10, 10], [4.5 / 40, 4.5 / 40], atol=1e-6)
    np.testing.assert_allclose(found["offset"][:, 19, 40], [-10 / 40, -4.5 / 40], atol=1e-6)
    assert (found["offset"][:, ~known] == 0).all()
    # The blob is 0.03 heights = 1.2 pixels wide.
    assert found["heat"][14, 30] == pytest.approx(np.exp(-0.5 * 0.25 / 1.44), rel=1e-5)
    assert found["heat"][14, 32] == pytest.approx(np.exp(-0.5 * (4 + 0.25) / 1.44), rel=1e-5)
    assert found["heat"][31, 51] < 1e-6, "too small to be asked for"
    assert found["heat"][30, 7] < 1e-6, "people have no middle"
    edge = found["boundary"] > 0
    assert set(np.unique(found["boundary"])) == {0.0, 1.0}
    assert edge[14, 19]
    assert edge[14, 20], "between chair and table, on both sides"
    assert edge[9, 15]
    assert edge[10, 15]
    assert not edge[14, 15]
    assert edge[30, 5]
    assert edge[30, 4], "around the person"
    assert not edge[8, 3], "not where the wall meets the floor"


def test_one_instance_on_both_sides_of_a_person_has_one_center() -> None:
    _, found = targets([
        (5, (slice(10, 20), slice(10, 40)), "furniture"), (1, (slice(5, 30), slice(20, 24)), "person"),
    ])  # fmt: skip
    x = np.concatenate([np.arange(10, 20), np.arange(24, 40)])
    assert found["offset"][0, 12, 10] == pytest.approx((x.mean() - 10) / 40, abs=1e-6)
    assert found["offset"][0, 12, 39] == pytest.approx((x.mean() - 39) / 40, abs=1e-6)
    assert (found["has_offset"][5:30, 20:24] == 0).all()


def test_a_sample_depends_on_seed_and_step_alone(tmp_path: Path) -> None:
    folder = write_shards(tmp_path / "set")
    one, two, other = (PictureShards([folder], seed=seed) for seed in (4, 4, 5))
    one.batch(0, 2, (64, 96))  # an earlier step leaves no trace
    first, second = one.batch(7, 2, (64, 96)), two.batch(7, 2, (64, 96))
    for name in PictureBatch.__slots__:
        torch.testing.assert_close(getattr(first, name), getattr(second, name), rtol=0, atol=0)
    assert not torch.equal(first.picture, one.batch(8, 2, (64, 96)).picture)
    assert not torch.equal(first.picture, other.batch(7, 2, (64, 96)).picture)


def test_degraded_images_keep_most_of_their_content() -> None:
    rgb = torch.tensor(rendered(0)["rgb"]).permute(2, 0, 1).float()
    found = degraded(rgb.expand(40, -1, -1, -1), torch.Generator().manual_seed(2)).numpy()
    assert found.shape == (40, 3, HEIGHT, WIDTH)
    assert found.min() >= 0
    assert found.max() <= 255
    again = degraded(rgb.expand(40, -1, -1, -1), torch.Generator().manual_seed(2)).numpy()
    np.testing.assert_array_equal(found, again)
    assert np.abs(found - rgb.numpy()).mean() > 10
    assert len({picture.tobytes() for picture in found}) == 40
    edges = np.abs(np.diff(rgb.numpy().sum(0), axis=1)) > 60
    kept = [np.abs(np.diff(picture.sum(0), axis=1)) for picture in found]
    assert np.median([change[edges].mean() / change[~edges].mean() for change in kept]) > 4


def test_a_third_of_a_turn_of_hue_exchanges_the_colors() -> None:
    picture = torch.rand(2, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    turned = turned_hue(picture, torch.tensor([0.0, 2 * np.pi / 3]).reshape(2, 1, 1, 1))
    torch.testing.assert_close(turned[0], picture[0], rtol=0, atol=1e-6)
    torch.testing.assert_close(turned[1], picture[1][[2, 0, 1]], rtol=0, atol=1e-6)


def test_compression_loses_what_the_quantization_table_says() -> None:
    """Quality 50 has the table itself: a coefficient just under half of its step is lost, one just above becomes it."""
    columns = np.tile(np.arange(8), (8, 1))
    wave = np.cos(np.pi * (columns + 0.5) / 8) * 0.125**0.5 * 0.5  # of one cycle across, whose step is 11
    for coefficient, wanted in ((5.4, 0.0), (5.6, 11.0), (30.0, 33.0)):
        block = torch.tensor(128 + coefficient * wave, dtype=torch.float32).expand(1, 3, 8, 8)
        found = compressed(block, torch.full((1, 1, 1, 1), 50.0))
        torch.testing.assert_close(
            found, torch.tensor(128 + wanted * wave).float().expand(1, 3, 8, 8), atol=1e-3, rtol=0
        )


def test_shards_that_are_finished_later_are_found(tmp_path: Path) -> None:
    folder = write_shards(tmp_path / "set")
    unfinished = tmp_path / "set" / "shard_00001"
    write_shards(tmp_path / "aside", number=1)
    (tmp_path / "aside" / "shard_00001").rename(unfinished)
    (unfinished / "meta.json").rename(unfinished / "meta.part")
    shards = PictureShards([folder])
    assert len(shards) == 2
    (unfinished / "meta.part").rename(unfinished / "meta.json")
    shards.refresh(wait=True)
    shards.refresh(wait=True)
    assert len(shards) == 4
    torch.testing.assert_close(shards.plain([3], (64, 96)).picture, shards.plain([1], (64, 96)).picture)


def test_no_shards_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no finished shards in .*absent.*video2anim synth"):
        PictureShards([tmp_path / "absent"])
