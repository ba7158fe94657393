"""What a chosen camera shows: color, mask, depth, how much is visible, and the same without what hides the target."""

from dataclasses import dataclass

import numpy as np

from reconstruction.core.types import Camera
from reconstruction.gaussians.model import SH_C0
from reconstruction.gaussians.rasterizer import RasterSettings, rasterize
from reconstruction.views.inpainting import Inpainter
from reconstruction.views.scene import Target, ViewScene, reach_of

_OPAQUE = 0.5
_WHOLE_HIDES = 0.1  # a thing that covers this share of the target's outline is taken away as a whole
_NEARER = 0.97  # of the target's depth: what lies nearer than this within its outline hides it
_HOLE_BORDER_PX = 2
_SETTINGS = RasterSettings(near=0.02)


@dataclass(frozen=True)
class View:
    """One view of a target. World space, metres; pictures have the camera's size."""

    target: tuple[int, ...]  # ids
    world_from_camera: np.ndarray  # float64 (4, 4), OpenCV, upright
    camera: Camera
    origin: str  # how it was found, for people
    gain: float  # share of the target's opacity that it shows and no view before it did
    color: np.ndarray  # uint8 (h, w, 3) RGB of the whole scene, black where nothing is known
    alpha: np.ndarray  # float32 (h, w) the target's own opacity, behind what hides it
    depth: np.ndarray  # float32 (h, w) z-depth of the target where alpha > 0.5, else 0
    outline: (
        np.ndarray
    )  # bool (h, w) where the target would be seen if nothing hid it, what no frame saw of it too
    visibility: float  # share of the outline that nothing hides
    fronts: (
        float  # share of what is seen of it that frames saw; the rest are backs, through sides that none saw
    )
    clean: np.ndarray  # uint8 (h, w, 3) without what hides the target, holes inpainted
    inpainted: np.ndarray  # bool (h, w) which pixels of `clean` are made up

    @property
    def mask(self) -> np.ndarray:
        """Where the target is seen, bool (h, w)."""
        return self.alpha > _OPAQUE

    def cleared(self, margin: float = 0.25) -> tuple[np.ndarray, np.ndarray] | None:
        """Return `clean`, uint8 (h, w, 3), and where the target is in it, bool (h, w), cropped to the target.

        Args:
            margin: of what is around it, as a share of its box on each side.

        Returns:
            None where nothing of it is in the picture.
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


def draw_view(
    scene: ViewScene,
    target: Target,
    camera: Camera,
    pose: np.ndarray,
    origin: str,
    gain: float,
    fronts: float,
    inpainter: Inpainter,
) -> View:
    """Draw a view.

    Args:
        scene: of `prepare_scene`.
        target: what is looked at.
        camera: of the pictures.
        pose: (4, 4) world_from_camera.
        origin: as in `View`.
        gain: as in `View`.
        fronts: as in `View`.
        inpainter: for `clean`.
    """
    own = np.zeros(len(scene.packed), bool)
    own[target.rows] = True
    whole = rasterize(scene.packed, camera, pose, _SETTINGS).features
    alone = rasterize(scene.packed[own], camera, pose, _SETTINGS).features
    outline = alone[..., 7]
    alpha = _own_alpha(scene, own, camera, pose, outline)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(outline > 1e-6, alone[..., 3] / outline, 0.0)
    clean, holes = _without_occluders(scene, own, camera, pose, outline > _OPAQUE, depth, whole)
    behind = _hidden_holes(outline > _OPAQUE, depth, whole)
    holes |= _grown(behind)
    total = float(outline.sum())
    return View(
        target=target.ids,
        world_from_camera=pose,
        camera=camera,
        origin=origin,
        gain=gain,
        color=_uint8(whole[..., :3]),
        alpha=alpha,
        depth=np.where(alpha > _OPAQUE, depth, 0.0).astype(np.float32),
        outline=(outline > _OPAQUE) | behind,
        fronts=fronts,
        visibility=min(float(alpha.sum()) / total, 1.0) if total > 0 else 0.0,
        clean=inpainter.inpaint(clean, holes),
        inpainted=holes,
    )


def _own_alpha(
    scene: ViewScene, own: np.ndarray, camera: Camera, pose: np.ndarray, outline: np.ndarray
) -> np.ndarray:
    """Return the opacity (h, w) of the target behind what hides it; only what may lie before it is drawn."""
    out = np.zeros(outline.shape, np.float32)
    window = _window_of(outline > 0)
    if window is None:
        return out
    local = (scene.packed[:, :3] - pose[:3, 3]) @ pose[:3, :3]
    reach = reach_of(scene.packed, _SETTINGS.sigma_cutoff)
    far = float((local[own, 2] + reach[own]).max())
    marked = scene.packed[local[:, 2] <= far]  # sorted by the depth of their centers
    mine = own[local[:, 2] <= far]
    marked[:, 10:13] = (
        np.where(mine[:, None], 0.5, -0.5) / SH_C0
    )  # drawn as 1 where it is the target's, else 0
    out[window] = rasterize(marked, _cropped(camera, window), pose, _SETTINGS).features[..., 0]
    return out


def _window_of(mask: np.ndarray) -> tuple[slice, slice] | None:
    """Return rows and columns of the box around a mask (h, w); None where it is empty."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)) if len(rows) else None


def _cropped(camera: Camera, window: tuple[slice, slice]) -> Camera:
    """Return the camera of a part of its picture."""
    rows, columns = window
    width, height = int(columns.stop - columns.start), int(rows.stop - rows.start)
    return Camera(
        width, height, camera.fx, camera.fy, camera.cx - float(columns.start), camera.cy - float(rows.start)
    )


def _without_occluders(
    scene: ViewScene,
    own: np.ndarray,
    camera: Camera,
    pose: np.ndarray,
    outline: np.ndarray,
    depth: np.ndarray,
    whole: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the picture (h, w, 3) without what lies before the target, and where nothing is left to show (h, w).

    Outside of what is taken away it is that of the whole scene (features (h, w, c)), which is not drawn again.
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


def _hidden_holes(outline: np.ndarray, depth: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Return what the outline (h, w) surrounds that no frame saw because other things hide it, bool (h, w).

    There the scene (features (h, w, c)) is nearer than the target (depth (h, w)) around; through open ones it is not.
    """
    import cv2

    edges, _ = cv2.findContours(outline.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = cv2.drawContours(np.zeros(outline.shape, np.uint8), edges, -1, 1, cv2.FILLED)
    count, parts = cv2.connectedComponents(filled & ~outline, connectivity=4)
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
    """Return which Gaussians (g,) have their centers within the target's outline, nearer than it."""
    local = (scene.packed[:, :3] - pose[:3, 3]) @ pose[:3, :3]
    z = np.maximum(local[:, 2], 1e-6)
    u = np.floor(camera.fx * local[:, 0] / z + camera.cx).astype(np.int64)
    v = np.floor(camera.fy * local[:, 1] / z + camera.cy).astype(np.int64)
    inside = (local[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height) & ~own
    out = np.zeros(len(own), bool)
    rows = np.flatnonzero(inside)
    u, v = u[rows], v[rows]
    out[rows] = outline[v, u] & (local[rows, 2] < _NEARER * depth[v, u])
    return out


def _covered(
    scene: ViewScene, rows: np.ndarray, camera: Camera, pose: np.ndarray, outline: np.ndarray
) -> float:
    """Return the share of the outline that some Gaussians cover."""
    small = camera.resized(max(camera.width // 4, 8), max(camera.height // 4, 8))
    opacity = rasterize(scene.packed[rows], small, pose, _SETTINGS).features[..., 7]
    rows_v = np.arange(small.height) * camera.height // small.height
    columns = np.arange(small.width) * camera.width // small.width
    inside = outline[np.ix_(rows_v, columns)]
    return float((opacity[inside] > _OPAQUE).mean()) if inside.any() else 0.0


def _filled(outline: np.ndarray) -> np.ndarray:
    """Return an outline with what it surrounds and is thin or small: gaps between Gaussians, which are inpainted."""
    import cv2

    closed = cv2.morphologyEx(outline.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    return closed.astype(bool)


def _grown(holes: np.ndarray) -> np.ndarray:
    """Return the holes with their dark border."""
    import cv2

    kernel = np.ones((2 * _HOLE_BORDER_PX + 1,) * 2, np.uint8)
    return cv2.dilate(holes.astype(np.uint8), kernel).astype(bool)


def _uint8(color: np.ndarray) -> np.ndarray:
    return np.round(np.clip(color, 0, 1) * 255).astype(np.uint8)
