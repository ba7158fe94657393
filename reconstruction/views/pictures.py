"""Render the pictures of a viewpoint: color, mask, depth, visibility, and the view with occluders removed."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from reconstruction.core.types import Camera
from reconstruction.gaussians.model import SH_C0
from reconstruction.gaussians.rasterizer import RasterSettings, rasterize
from reconstruction.views.inpainting import Inpainter
from reconstruction.views.scene import Target, ViewScene, reach_of

if TYPE_CHECKING:
    from reconstruction.views.strategies import Viewpoint

_OPAQUE = 0.5
_WHOLE_HIDES = 0.1  # an object that covers more than this share of the target's outline is removed as a whole
_NEARER = 0.97  # Gaussians within the outline nearer than this share of the target's depth are occluders
_HOLE_BORDER_PX = 2  # dark border of holes, which is inpainted as well
_SETTINGS = RasterSettings(near=0.02)


@dataclass(frozen=True)
class View:
    """One view of a target; world space, metres."""

    target: tuple[int, ...]  # instance ids
    world_from_camera: np.ndarray  # float64 (4, 4) rigid, no roll
    camera: Camera
    origin: str  # how the viewpoint was found, for users
    gain: float  # share of the target's opacity that no earlier view shows
    color: np.ndarray  # uint8 (h, w, 3) RGB of the whole scene, black where nothing is known
    alpha: np.ndarray  # float32 (h, w) opacity of the target behind its occluders
    depth: np.ndarray  # float32 (h, w) z-depth of the target where alpha > 0.5, else 0
    outline: np.ndarray  # bool (h, w) silhouette of the target without occluders, with enclosed unseen holes
    visibility: float  # share of the silhouette that is not occluded
    fronts: float  # share of front sides, which frames saw, in the visible target; the rest are backs
    clean: np.ndarray  # uint8 (h, w, 3) RGB without occluders, holes inpainted
    inpainted: np.ndarray  # bool (h, w) inpainted pixels of `clean`

    @property
    def mask(self) -> np.ndarray:
        """Pixels of the visible target, bool (h, w)."""
        return self.alpha > _OPAQUE

    def cleared(self, margin: float = 0.25) -> tuple[np.ndarray, np.ndarray] | None:
        """Return `clean`, uint8 (h, w, 3), and the target's mask, bool (h, w), cropped to the target.

        Args:
            margin: kept on each side, as a share of the target's box.

        Returns:
            None if the target is not in the picture.
        """
        whole = _filled(self.outline)
        if not whole.any():
            return None
        window = []
        for axis in (1, 0):
            rows = np.flatnonzero(whole.any(axis=axis))
            pad = round(margin * (rows[-1] - rows[0] + 1)) + 2
            window.append(slice(max(0, rows[0] - pad), rows[-1] + 1 + pad))
        return np.ascontiguousarray(self.clean[tuple(window)]), whole[tuple(window)]


def draw_view(scene: ViewScene, target: Target, point: "Viewpoint", inpainter: Inpainter) -> View:
    """Render the pictures of a viewpoint at the size of its camera; `inpainter` fills holes of `View.clean`."""
    camera, pose = point.camera, point.world_from_camera
    own = np.zeros(len(scene.packed), bool)
    own[target.rows] = True
    whole = rasterize(scene.packed, camera, pose, _SETTINGS).features
    alone = rasterize(scene.packed[own], camera, pose, _SETTINGS).features
    outline = alone[..., 7]
    alpha = _own_alpha(scene, own, camera, pose, outline)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(outline > 1e-6, alone[..., 3] / outline, 0.0)
    clean, holes = _without_occluders(scene, own, camera, pose, outline > _OPAQUE, depth, whole)
    behind = hidden_holes(outline > _OPAQUE, depth, whole)
    holes |= _grown(behind)
    total = float(outline.sum())
    return View(
        target=target.ids,
        world_from_camera=pose,
        camera=camera,
        origin=point.origin,
        gain=point.gain,
        color=_uint8(whole[..., :3]),
        alpha=alpha,
        depth=np.where(alpha > _OPAQUE, depth, 0.0).astype(np.float32),
        outline=(outline > _OPAQUE) | behind,
        fronts=point.fronts,
        visibility=min(float(alpha.sum()) / total, 1.0) if total > 0 else 0.0,
        clean=inpainter.inpaint(clean, holes),
        inpainted=holes,
    )


def _own_alpha(
    scene: ViewScene, own: np.ndarray, camera: Camera, pose: np.ndarray, outline: np.ndarray
) -> np.ndarray:
    """Return the opacity (h, w) of the target behind its occluders; only Gaussians before its far end are drawn."""
    out = np.zeros(outline.shape, np.float32)
    window = _window_of(outline > 0)
    if window is None:
        return out
    local = (scene.packed[:, :3] - pose[:3, 3]) @ pose[:3, :3]
    reach = reach_of(scene.packed, _SETTINGS.sigma_cutoff)
    far = float((local[own, 2] + reach[own]).max())
    marked, mine = scene.packed[local[:, 2] <= far], own[local[:, 2] <= far]
    marked[:, 10:13] = np.where(mine[:, None], 0.5, -0.5) / SH_C0  # color 1 for the target, 0 for the others
    out[window] = rasterize(marked, _cropped(camera, window), pose, _SETTINGS).features[..., 0]
    return out


def _window_of(mask: np.ndarray) -> tuple[slice, slice] | None:
    """Return the bounding box of a mask (h, w) as slices of rows and columns; None if it is empty."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)) if len(rows) else None


def _cropped(camera: Camera, window: tuple[slice, slice]) -> Camera:
    """Return the camera of a window (rows, columns) of the image."""
    rows, columns = window
    x, y = int(columns.start), int(rows.start)
    width, height = int(columns.stop) - x, int(rows.stop) - y
    return Camera(width, height, camera.fx, camera.fy, camera.cx - float(x), camera.cy - float(y))


def _without_occluders(
    scene: ViewScene, own: np.ndarray, camera: Camera, pose: np.ndarray, outline: np.ndarray, depth: np.ndarray,
    whole: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the picture (h, w, 3) with the target's occluders removed, and the mask (h, w) of holes in it.

    Only the window that the removed Gaussians touch is drawn again; the rest comes from the features `whole` (h, w, c).
    """
    before = _before_target(scene, own, camera, pose, outline, depth)
    share = {
        int(i): _covered(scene, (scene.instance == i) & before, camera, pose, outline)
        for i in np.unique(scene.instance[before])
    }
    things = [i for i, covered in share.items() if i and i not in scene.base and covered > _WHOLE_HIDES]
    taken = before | (np.isin(scene.instance, things) & ~own)
    features = whole
    if taken.any():
        touched = rasterize(scene.packed[taken], camera, pose, _SETTINGS).features[..., 7] > 0
        window = _window_of(touched)
        if window is not None:
            features = whole.copy()
            drawn = rasterize(scene.packed[~taken], _cropped(camera, window), pose, _SETTINGS)
            features[window] = drawn.features
    opacity = features[..., 7]
    color = features[..., :3] / np.maximum(opacity, 1e-3)[..., None]
    return _uint8(np.where(opacity[..., None] > _OPAQUE, color, 0.0)), _grown(opacity <= _OPAQUE)


def hidden_holes(outline: np.ndarray, depth: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Return the holes enclosed by the silhouette (h, w) that are unseen because of occluders, bool (h, w).

    There the scene (features `whole` (h, w, c)) is nearer than the target around the hole; in true openings it is not.
    """
    import cv2

    edges, _ = cv2.findContours(outline.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = cv2.drawContours(np.zeros(outline.shape, np.uint8), edges, -1, (1,), cv2.FILLED)
    count, parts = cv2.connectedComponents((filled & ~outline).astype(np.uint8), connectivity=4)
    scene_depth = whole[..., 3] / np.maximum(whole[..., 7], 1e-6)
    known = whole[..., 7] > _OPAQUE
    out = np.zeros(outline.shape, bool)
    for number in range(1, count):
        hole = parts == number
        around = cv2.dilate(hole.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool) & outline
        if not (hole & known).any() or not around.any():
            continue
        if np.median(scene_depth[hole & known]) < np.median(depth[around]):
            out |= hole
    return out


def _before_target(
    scene: ViewScene,
    own: np.ndarray,
    camera: Camera,
    pose: np.ndarray,
    outline: np.ndarray,
    depth: np.ndarray,
) -> np.ndarray:
    """Return the mask (g,) of Gaussians with centers inside of the silhouette and nearer than the target."""
    local = (scene.packed[:, :3] - pose[:3, 3]) @ pose[:3, :3]
    columns, rows = camera.project(np.column_stack([local[:, :2], np.maximum(local[:, 2], 1e-6)]))
    u, v = np.floor(columns).astype(np.int64), np.floor(rows).astype(np.int64)
    inside = (local[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height) & ~own
    out = np.zeros(len(own), bool)
    rows = np.flatnonzero(inside)
    u, v = u[rows], v[rows]
    out[rows] = outline[v, u] & (local[rows, 2] < _NEARER * depth[v, u])
    return out


def _covered(
    scene: ViewScene, rows: np.ndarray, camera: Camera, pose: np.ndarray, outline: np.ndarray
) -> float:
    """Return the share of the silhouette that the Gaussians `rows` cover, at a quarter of the resolution."""
    small = camera.resized(max(camera.width // 4, 8), max(camera.height // 4, 8))
    opacity = rasterize(scene.packed[rows], small, pose, _SETTINGS).features[..., 7]
    rows_v = np.arange(small.height) * camera.height // small.height
    columns = np.arange(small.width) * camera.width // small.width
    inside = outline[np.ix_(rows_v, columns)]
    return float((opacity[inside] > _OPAQUE).mean()) if inside.any() else 0.0


def _filled(outline: np.ndarray) -> np.ndarray:
    """Close thin gaps and small holes of a silhouette (h, w): gaps between Gaussians, which are inpainted."""
    import cv2

    closed = cv2.morphologyEx(outline.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    return closed.astype(bool)


def _grown(holes: np.ndarray) -> np.ndarray:
    """Dilate holes (h, w) by their dark border."""
    import cv2

    kernel = np.ones((2 * _HOLE_BORDER_PX + 1,) * 2, np.uint8)
    return cv2.dilate(holes.astype(np.uint8), kernel).astype(bool)


def _uint8(color: np.ndarray) -> np.ndarray:
    return np.round(np.clip(color, 0, 1) * 255).astype(np.uint8)
