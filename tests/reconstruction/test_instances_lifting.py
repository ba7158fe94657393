"""Masks of a hand-built room lifted onto its surface: whole, torn, merged, missing, renamed, and of any resolution."""

import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from surfaces import floor_sheet, frames_of, looking_at, merged, sheet, solid_box, surface_from

from reconstruction.config import PipelineConfig
from reconstruction.core.mesh_graph import MeshGraph
from reconstruction.core.progress import NO_PROGRESS
from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera, DepthMaps
from reconstruction.instances import InstancesConfig, find_instances
from reconstruction.instances.cut import Shell
from reconstruction.instances.id_maps import render_id_maps
from reconstruction.instances.lifting import lift_masks
from reconstruction.instances.mask_cut import cut_by_masks
from reconstruction.instances.masks import FrameMasks
from reconstruction.instances.superpoints import superpoints
from reconstruction.video_to_scene import reconstruct
from registry.errors import UsageError

pytestmark = pytest.mark.stage

WHITE = (200, 200, 190)
# The floor, a table, a box on it, a book of the table's color beside it, a cup on the book, a bin on the floor, a wall
# and a picture in it.
PARTS = {
    "floor": floor_sheet(WHITE, 1.0, 0.025),
    "wall": sheet((-1.0, 1.0, 0), (2.0, 0, 0), (0, 0, 1.2), (170, 170, 160), 0.025),
    "table": solid_box((-0.5, -0.4, 0.0), (0.5, 0.4, 0.5), (120, 80, 50)),
    "box": solid_box((-0.3, 0.0, 0.5), (-0.16, 0.1, 0.65), (200, 30, 30)),
    "book": solid_box((0.05, -0.1, 0.5), (0.3, 0.1, 0.54), (120, 80, 50)),
    "cup": solid_box((0.12, -0.05, 0.54), (0.2, 0.03, 0.64), (120, 80, 50)),
    "bin": solid_box((0.7, -0.3, 0.0), (0.9, -0.1, 0.3), (120, 120, 120)),
    "picture": sheet((-0.2, 0.99, 0.7), (0.5, 0, 0), (0, 0, 0.4), (40, 60, 160)),
}
PALETTE = np.array([[0, 0, 0], *([20 * i, 7 * i, 255 - 9 * i] for i in range(1, 9))], np.uint8)
NAMES = tuple(PARTS)
THINGS = ("table", "box", "book", "cup", "bin", "picture")
RESTS_ON = {"box": "table", "book": "table", "cup": "book", "table": None, "bin": None, "picture": None}


class Room:
    """A surface, frames of it, and which part each pixel of each frame shows."""

    def __init__(self, views: int = 8, size: tuple[int, int] = (160, 120)) -> None:
        self.surface = surface_from(merged(*PARTS.values()))
        angles = np.linspace(-2.6, -0.5, views)
        center = np.array([0.0, 0.0, 0.4])
        poses = np.stack(
            [looking_at(center + np.array([2.0 * np.cos(a), 2.0 * np.sin(a), 0.9]), center) for a in angles]
        )
        self.camera = Camera(*size, 0.8 * size[0], 0.8 * size[0], size[0] / 2, size[1] / 2)
        posed, _ = frames_of(self.surface)
        surface, camera = self.surface, self.camera
        depth = np.stack([rasterize_mesh(surface.vertices, surface.faces, camera, p).depth for p in poses])
        self.depth = DepthMaps(camera, depth, np.where(depth > 0, 2, 0).astype(np.uint8))
        images = np.zeros((views, size[1], size[0], 3), np.uint8)
        self.posed = replace(
            posed, camera=camera, images=images, indices=np.arange(1, views + 1, dtype=np.int32),
            times_s=np.arange(views) / 10, world_from_camera=poses, sharpness=np.ones(views, np.float32),
            held_out_images=images[:0],
        )  # fmt: skip
        self.parts = np.stack([self._seen(pose) for pose in poses])

    def _seen(self, pose: np.ndarray) -> np.ndarray:
        """Return the number of the part at each pixel, from 1 on, uint16 (h, w)."""
        out, nearest = np.zeros((self.camera.height, self.camera.width), np.uint16), np.inf
        for number, part in enumerate(PARTS.values(), start=1):
            drawn = rasterize_mesh(part.vertices, part.faces, self.camera, pose).depth
            # The picture lies before the wall by less than depth can tell: what comes later wins.
            closer = (drawn > 0) & (drawn <= nearest + 1e-6)
            out[closer], nearest = number, np.where(closer, drawn, nearest)
        return out

    def masks(self, ids: np.ndarray | None = None, chosen: slice = slice(None)) -> FrameMasks:
        ids = self.parts if ids is None else ids
        return FrameMasks(
            self.camera, self.posed.indices[chosen], self.posed.world_from_camera[chosen], ids[chosen]
        )

    def cut(self, masks: FrameMasks):
        shell = Shell.of(self.surface, NO_PROGRESS)
        return cut_by_masks(
            shell, self.surface, self.posed, self.depth, masks, InstancesConfig(), NO_PROGRESS
        )

    def part_of_vertices(self) -> np.ndarray:
        """Return the true part of each vertex, 0 where two meet."""
        points = np.round(self.surface.vertices, 4)
        out = np.zeros(len(points), np.int64)
        for number, part in enumerate(PARTS.values(), start=1):
            own = {tuple(p) for p in np.round(part.vertices, 4).astype(np.float32)}
            for row, point in enumerate(points):
                if tuple(point) in own:
                    out[row] = number if out[row] == 0 else -1
        return np.maximum(out, 0)


@pytest.fixture(scope="module")
def room() -> Room:
    return Room()


def assert_all_found(room: Room, masks: FrameMasks) -> None:
    """Every thing is one thing, on what it stands on, and nothing else is a thing."""
    cut, truth = room.cut(masks), room.part_of_vertices()
    found = {}
    for name in THINGS:
        own = np.flatnonzero(truth == NAMES.index(name) + 1)
        overlap = [np.isin(own, thing.vertices).sum() for thing in cut.things]
        best = int(np.argmax(overlap))
        thing = cut.things[best]
        assert overlap[best] > 0.4 * len(own), f"{name} is not found whole"  # no camera sees it from behind
        strays = truth[thing.vertices]
        strays = strays[(strays != NAMES.index("wall") + 1) | (name != "picture")]  # 1 cm behind it, hidden
        assert (strays[strays > 0] == NAMES.index(name) + 1).mean() > 0.85, f"{name} has parts of others"
        found[name] = thing
    assert len(cut.things) == len(THINGS)
    for name, carrier in RESTS_ON.items():
        wanted = None if carrier is None else found[carrier]
        assert found[name].rests_on is wanted, f"{name} should rest on {carrier}"
    assert found["picture"].attached
    assert not any(found[name].attached for name in THINGS if name != "picture")


def test_true_masks_find_every_thing(room):
    """Things of one color that the embedded rules could not tell apart are found, with what they stand on."""
    assert_all_found(room, room.masks())


def test_ids_of_two_frames_are_unrelated(room):
    rng = np.random.default_rng(3)
    ids = np.stack([np.append(0, rng.permutation(500)[:8] + 1)[frame] for frame in room.parts])
    assert_all_found(room, room.masks(ids.astype(np.uint16)))


def test_torn_masks_in_a_minority_of_frames(room):
    """Where two frames of eight cut everything into stripes, the others hold it together."""
    ids = room.parts.copy()
    stripe = (np.arange(ids.shape[2]) // 12 % 2).astype(np.uint16) * 100
    for row in (2, 5):
        ids[row] = np.where(ids[row] > 0, ids[row] + stripe, 0)
    assert_all_found(room, room.masks(ids))


def test_merged_masks_in_a_minority_of_frames(room):
    """Where two frames of eight take table, box, book and cup for one thing, the others have the say."""
    ids = room.parts.copy()
    for row in (1, 6):
        ids[row][np.isin(ids[row], [NAMES.index(n) + 1 for n in ("table", "box", "book", "cup")])] = 77
    assert_all_found(room, room.masks(ids))


def test_missing_masks(room):
    """Each frame lacks the masks of two parts; no mask at all is not a vote against."""
    ids = room.parts.copy()
    for row in range(len(ids)):
        ids[row][np.isin(ids[row], [row % 8 + 1, (row + 3) % 8 + 1])] = 0
    assert_all_found(room, room.masks(ids))


def test_few_frames_of_another_resolution(room):
    """Half of the frames, their masks at half the resolution of anything else."""
    small = room.camera.resized(80, 60)
    rows, columns = np.arange(60) * 2 + 1, np.arange(80) * 2 + 1
    ids = np.ascontiguousarray(room.parts[::2][:, rows[:, None], columns[None]])
    masks = FrameMasks(small, room.posed.indices[::2], room.posed.world_from_camera[::2], ids)
    cut = room.cut(masks)
    assert len(cut.things) == len(THINGS)


def test_nothing_is_found_without_masks(room):
    cut = room.cut(room.masks(np.zeros_like(room.parts)))
    assert cut.things == []


def test_a_hole_in_a_surface_shows_nothing(room):
    """Floor that is drawn through a hole in the table's surface is not seen there by a camera that saw the table."""
    surface = room.surface
    middle = surface.vertices[surface.faces].mean(axis=1)
    hole = (np.abs(middle[:, 0] + 0.35) < 0.1) & (np.abs(middle[:, 1] + 0.2) < 0.15) & (middle[:, 2] > 0.49)
    torn = replace(surface, faces=surface.faces[~hole])
    graph = MeshGraph.from_surface(torn)
    lifted = lift_masks(graph, torn, room.posed, room.depth, room.masks(), NO_PROGRESS)
    table = lifted.cluster[np.argmin(np.linalg.norm(surface.vertices - [0.45, -0.35, 0.5], axis=1))]
    floor_below = (surface.vertices[:, 2] < 0.01) & (
        np.abs(surface.vertices[:, :2] + [0.35, 0.2]) < [0.12, 0.15]
    ).all(1)
    assert table > 0
    assert not (lifted.cluster[floor_below] == table).any()


def test_same_bits_again(room):
    one, two = (
        lift_masks(
            MeshGraph.from_surface(room.surface),
            room.surface,
            room.posed,
            room.depth,
            room.masks(),
            NO_PROGRESS,
        )
        for _ in range(2)
    )
    np.testing.assert_array_equal(one.cluster, two.cluster)
    np.testing.assert_array_equal(one.share, two.share)


def test_superpoints_respect_creases_and_colors(room):
    """A superpoint is small, of one color and of one direction."""
    graph = MeshGraph.from_surface(room.surface)
    patches = superpoints(graph)
    count = patches.max() + 1
    assert 50 < count < 0.5 * len(patches)
    for axis in range(3):
        low, high = np.full(count, np.inf), np.full(count, -np.inf)
        np.minimum.at(low, patches, graph.points[:, axis])
        np.maximum.at(high, patches, graph.points[:, axis])
        assert (high - low).max() <= 0.0601
    truth = room.part_of_vertices()
    box, table = (truth == NAMES.index(n) + 1 for n in ("box", "table"))
    assert not set(patches[box]) & set(patches[table])


def test_superpoints_do_not_depend_on_spacing():
    """A finer mesh of the same sheet gets about as many superpoints."""
    plate = surface_from(sheet((0, 0, 0), (0.6, 0, 0), (0, 0.6, 0), WHITE))
    coarse = len(np.unique(superpoints(MeshGraph.from_surface(plate))))
    fine = replace(
        plate, vertices=plate.vertices * np.float32([0.5, 0.5, 1])
    )  # 5 mm cells, a quarter of the area
    assert 0.5 < len(np.unique(superpoints(MeshGraph.from_surface(fine)))) / (coarse / 4) < 2.0


def test_time_grows_linearly():
    """Four times the surface takes about four times as long: far from sixteen times."""

    def seconds(side_m: float) -> float:
        graph = MeshGraph.from_surface(surface_from(sheet((0, 0, 0), (side_m, 0, 0), (0, side_m, 0), WHITE)))
        begun = time.process_time()
        superpoints(graph)
        return time.process_time() - begun

    seconds(0.2)
    small, large = (min(seconds(side) for _ in range(3)) for side in (0.8, 1.6))
    assert large < 10 * small


def write_masks(room: Room, folder: Path, name=lambda index: f"{index:05d}.png", **options) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for index, ids in zip(room.posed.indices, room.parts):
        cv2.imwrite(str(folder / name(int(index))), options.get("draw", lambda x: x)(ids))
    return folder


def find(room: Room, folder: Path, notes: list | None = None):
    class Listener:
        start = advance = staticmethod(lambda *_: None)
        note = staticmethod((notes if notes is not None else []).append)

    config = InstancesConfig(
        masks="folder", masks_path=str(folder), snap_radius_px=0, min_object_image_share=0
    )
    return find_instances(room.posed, room.depth, room.surface, config, progress=Listener())


def test_folder_of_id_images(room, tmp_path):
    """The whole stage on a folder: things, hints, and a note that says how many frames matched."""
    notes: list[str] = []
    found = find(room, write_masks(room, tmp_path / "masks"), notes)
    assert len(found.objects) == len(THINGS)
    assert set(np.unique(found.vertex_instance)) <= {0, *found.static_ids, *(o.id for o in found.objects)}
    assert any("masks of 8 of 8 frames" in note for note in notes)
    picture = next(o for o in found.objects if o.attached_hint)
    np.testing.assert_allclose(picture.extents_m[1:], [0.5, 0.4], atol=0.05)


@pytest.mark.parametrize(
    ("name", "draw"),
    [
        (lambda index: f"frame_{index}.png", lambda ids: ids.astype(np.uint8)),
        (lambda index: f"{index:03d}.png", lambda ids: PALETTE[ids]),
        (lambda index: f"{index}.png", lambda ids: cv2.resize(ids, (480, 360), interpolation=cv2.INTER_NEAREST)),
    ],
)  # fmt: skip
def test_folder_forms(room, tmp_path, name, draw):
    """8 bit, color-coded, another size, any zero padding: all the same."""
    found = find(room, write_masks(room, tmp_path, name, draw=draw))
    assert len(found.objects) == len(THINGS)


def test_folder_of_held_out_frames_only(room, tmp_path):
    """Masks of frames that nothing else was fitted to are as good."""
    kept, held = slice(0, None, 2), slice(1, None, 2)
    posed = replace(
        room.posed, images=room.posed.images[kept], indices=room.posed.indices[kept],
        world_from_camera=room.posed.world_from_camera[kept], times_s=room.posed.times_s[kept],
        sharpness=room.posed.sharpness[kept], held_out_images=room.posed.images[held],
        held_out_indices=room.posed.indices[held], held_out_times_s=room.posed.times_s[held],
        held_out_world_from_camera=room.posed.world_from_camera[held],
    )  # fmt: skip
    depth = replace(room.depth, depth=room.depth.depth[kept], confidence=room.depth.confidence[kept])
    for index, ids in zip(posed.held_out_indices, room.parts[held]):
        cv2.imwrite(str(tmp_path / f"{index:05d}.png"), ids)
    config = InstancesConfig(masks="folder", masks_path=str(tmp_path), min_object_image_share=0)
    found = find_instances(posed, depth, room.surface, config, progress=NO_PROGRESS)
    assert len(found.objects) == len(THINGS)
    assert len(found.id_maps) == len(posed.images)


def test_masks_reach_keyframes_that_have_none(room):
    """Things that drag along what is around them are drawn fat; masks follow the picture."""
    spoiled = room.part_of_vertices()
    things = {name: NAMES.index(name) + 1 for name in ("box", "cup")}
    for number in things.values():
        own = room.surface.vertices[spoiled == number]
        spoiled[cKDTree(own).query(room.surface.vertices)[0] < 0.06] = number
    config = InstancesConfig(snap_radius_px=0)

    def maps(told: FrameMasks | None) -> np.ndarray:
        return render_id_maps(
            room.posed, room.depth, room.surface, spoiled, config, told, progress=NO_PROGRESS
        )

    carried, drawn = maps(room.masks(chosen=slice(0, None, 2))), maps(None)
    for number in things.values():
        own = room.parts[1::2] == number
        assert iou(drawn[1::2] == number, own) < 0.8
        assert iou(carried[1::2] == number, own) > 0.9
    nothing = room.masks(np.zeros_like(room.parts))
    np.testing.assert_array_equal(maps(nothing), [cv2.medianBlur(ids, 3) for ids in drawn])


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return np.count_nonzero(a & b) / np.count_nonzero(a | b)


def test_folder_errors(room, tmp_path):
    """Each mistake is one clear message."""
    with pytest.raises(UsageError, match="needs instances"):
        find_instances(
            room.posed, room.depth, room.surface, InstancesConfig(masks="folder"), progress=NO_PROGRESS
        )
    with pytest.raises(UsageError, match="no such folder"):
        find(room, tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match="no PNG"):
        find(room, tmp_path / "empty")
    with pytest.raises(UsageError, match="none of its 8 images"):
        find(room, write_masks(room, tmp_path / "others", lambda index: f"{index + 900}.png"))
    cv2.imwrite(str(write_masks(room, tmp_path / "twice") / "1.png"), room.parts[0])
    with pytest.raises(UsageError, match="both name frame 1"):
        find(room, tmp_path / "twice")
    with pytest.raises(UsageError, match="must show its whole frame"):
        find(room, write_masks(room, tmp_path / "wide", draw=lambda ids: ids[:60]))
    noise = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)
    write_masks(room, tmp_path / "photo", draw=lambda ids: noise)
    with pytest.raises(UsageError, match="colors"):
        find(room, tmp_path / "photo")
    (write_masks(room, tmp_path / "broken") / "00003.png").write_bytes(b"no image")
    with pytest.raises(UsageError, match="cannot be read"):
        find(room, tmp_path / "broken")


def test_a_wrong_folder_is_said_before_any_work(tmp_path):
    """Not even the video is opened, which is none here."""
    video = tmp_path / "room.mp4"
    video.write_bytes(b"no video")
    config = PipelineConfig(instances=InstancesConfig(masks="folder", masks_path=str(tmp_path / "nowhere")))
    with pytest.raises(UsageError, match="no such folder"):
        reconstruct(video, registry_root=tmp_path / "registry", config=config)
    assert not (tmp_path / "registry").exists()
