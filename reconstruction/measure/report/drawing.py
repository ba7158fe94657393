"""Small drawing tools: colors, normals, light, outlines, numbers, cameras that frame a thing, data URIs."""

import base64
from functools import cache
from typing import TYPE_CHECKING

import cv2
import numpy as np

from reconstruction.core.rasterize import Raster, rasterize_mesh
from reconstruction.core.types import Camera, TexturedMesh
from reconstruction.publish.preview import render_textured
from registry.geometry import rigid, transform_points

if TYPE_CHECKING:
    from PIL import ImageFont

BACKGROUND = np.array([236, 238, 241], np.uint8)
UNKNOWN = np.array([222, 224, 228], np.uint8)
PAPER = np.array([205, 208, 212], np.float32)
ERROR_MAP = "YlOrRd"
_FAR = 40.0  # A camera this many radii away is orthographic to a percent.

Placed = tuple[TexturedMesh, np.ndarray]  # a mesh with its world_from_mesh


def data_uri(image: np.ndarray, quality: int = 82) -> str:
    """Encode uint8 RGB (h, w, 3) as a JPEG data URI."""
    flags = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    _, encoded = cv2.imencode(".jpg", cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2BGR), flags)
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()


def fit_width(image: np.ndarray, width: int) -> np.ndarray:
    """Return the picture at this width; never larger than it is."""
    if image.shape[1] <= width:
        return np.ascontiguousarray(image)
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return cv2.resize(np.asarray(image), (width, height), interpolation=cv2.INTER_AREA)


@cache
def color_table(name: str) -> np.ndarray:
    """Return a color map of matplotlib as uint8 (256, 3)."""
    import matplotlib

    return (matplotlib.colormaps[name](np.linspace(0, 1, 256))[:, :3] * 255).round().astype(np.uint8)


def colorize(values: np.ndarray, low: float, high: float, name: str, known: np.ndarray) -> np.ndarray:
    """Color values (...) between two limits; gray where not known. Returns uint8 (..., 3)."""
    level = np.clip((np.nan_to_num(values) - low) / max(high - low, 1e-9), 0, 1)
    picture = color_table(name)[(level * 255).round().astype(np.int64)]
    picture[~known] = UNKNOWN
    return picture


def gradient(name: str) -> str:
    """Return the same color map as a CSS gradient, for legends."""
    stops = color_table(name)[np.linspace(0, 255, 9).astype(int)]
    return "linear-gradient(90deg," + ",".join("#{:02x}{:02x}{:02x}".format(*c) for c in stops) + ")"


def object_color(rank: int) -> tuple[int, int, int]:
    """Return a color for the rank-th object; neighbors in rank are far apart in hue."""
    hue = np.uint8([[[int(179 * ((0.07 + rank * 0.381966) % 1.0)), 175, 226]]])
    return tuple(int(c) for c in cv2.cvtColor(hue, cv2.COLOR_HSV2RGB)[0, 0])


def css_color(color: tuple[int, int, int]) -> str:
    """Return `#rrggbb`."""
    return "#{:02x}{:02x}{:02x}".format(*color)


def camera_normals(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Return unit normals float32 (h, w, 3) towards the camera, in its space, of a z-depth map; 0 where unknown.

    Of the differences to the left and right (up and down) the smaller is used, so that normals hold at edges.
    """
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.dstack(
        [(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(depth.shape)]
    )
    points = rays * depth[..., None].astype(np.float64)

    def derivative(axis: int) -> tuple[np.ndarray, np.ndarray]:
        ahead = np.roll(points, -1, axis) - points
        valid = (depth > 0) & (np.roll(depth, -1, axis) > 0)
        edge = [slice(None), slice(None)]
        edge[axis] = -1
        valid[tuple(edge)] = False
        behind, behind_valid = np.roll(ahead, 1, axis), np.roll(valid, 1, axis)
        better = behind_valid & (~valid | (np.abs(behind[..., 2]) < np.abs(ahead[..., 2])))
        return np.where(better[..., None], behind, ahead), valid | behind_valid

    (across, known_x), (down, known_y) = derivative(1), derivative(0)
    normals = np.cross(down, across)
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    normals = np.where(length > 0, normals / np.maximum(length, 1e-12), 0)
    normals *= np.where((normals * rays).sum(axis=2, keepdims=True) > 0, -1.0, 1.0)
    normals[~(known_x & known_y)] = 0
    return normals.astype(np.float32)


def normal_colors(normals: np.ndarray) -> np.ndarray:
    """Color unit normals (h, w, 3) as (n + 1) / 2; gray where they are zero."""
    picture = ((normals + 1) * 127.5).round().astype(np.uint8)
    picture[~normals.any(axis=2)] = UNKNOWN
    return picture


def shaded(picture: np.ndarray, depth: np.ndarray, camera: Camera, strength: float = 0.45) -> np.ndarray:
    """Darken what is turned away from the camera, so that shape shows; the background stays as it is."""
    slope = -camera_normals(depth, camera)[..., 2]
    light = np.where((depth > 0) & (slope > 0), 1 - strength * (1 - slope), 1.0)
    light = cv2.blur(light.astype(np.float32), (3, 3))[..., None]
    return np.where(depth[..., None] > 0, picture * light, picture).round().astype(np.uint8)


def render_ids(meshes: list[tuple[int, Placed]], camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Return int32 (h, w): which of the numbered meshes is seen where, 0 = none."""
    ids, depth = np.zeros((camera.height, camera.width), np.int32), None
    for number, (mesh, world_from_mesh) in meshes:
        raster = rasterize_mesh(transform_points(world_from_mesh, mesh.vertices), mesh.faces, camera, pose)
        nearer = raster.face >= 0
        if depth is None:
            depth = np.where(nearer, raster.depth, np.inf)
        else:
            nearer &= raster.depth < depth
            depth = np.where(nearer, raster.depth, depth)
        ids[nearer] = number
    return ids


def render_lit(meshes: list[Placed], camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Draw textured meshes with a little light from the camera."""
    picture, depth = render_textured(meshes, camera, pose)
    return shaded(picture, depth, camera)


def render_colored(
    vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray, camera: Camera, pose: np.ndarray
) -> np.ndarray:
    """Draw a mesh with vertex colors (v, 3) of 0..255, lit from the camera, smoothed by two samples a side."""
    big = camera.resized(2 * camera.width, 2 * camera.height)
    raster: Raster = rasterize_mesh(vertices, faces, big, pose)
    picture = np.where(
        (raster.face >= 0)[..., None], raster.interpolate(faces, np.asarray(colors, np.float32)), BACKGROUND
    )
    picture = shaded(picture, raster.depth, big)
    return cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def facing(vertices: np.ndarray, faces: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Tell which faces (f,) show their front to a camera: walls seen from behind are then left out."""
    a, b, c = (np.asarray(vertices, np.float64)[faces[:, k]] for k in range(3))
    return (np.cross(b - a, c - a) * (pose[:3, 3] - a)).sum(axis=1) > 0


def looking(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Return the rotation (3, 3) world_from_camera of an upright camera that stands there and looks at the origin."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    back = np.array(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    )
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return np.column_stack([right, np.cross(right, back), -back])


def framing_camera(
    points: np.ndarray,
    azimuth_deg: float,
    elevation_deg: float,
    width: int,
    height: int | None = None,
    margin: float = 0.04,
) -> tuple[Camera, np.ndarray]:
    """Return a far camera, nearly orthographic, that frames points (n, 3) from a direction, and its pose.

    Without a height the picture is as high as the points need, at most 1.2 times its width.
    """
    rotation = looking(azimuth_deg, elevation_deg)
    local = np.asarray(points, np.float64) @ rotation
    low, high = local.min(axis=0), local.max(axis=0)
    center, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-3)
    distance = _FAR * radius
    size = np.maximum(high - low, 1e-3)[:2] * (1 + 2 * margin)
    if height is None:
        height = int(np.clip(round(width * size[1] / size[0]), width // 4, round(1.2 * width)))
    focal = distance * min(width / size[0], height / size[1])
    center[2] -= distance
    return Camera(width, height, focal, focal, width / 2, height / 2), rigid(rotation, rotation @ center)


def outlined(
    image: np.ndarray,
    ids: np.ndarray,
    colors: dict[int, tuple[int, int, int]],
    labels: dict[int, str] | None = None,
    tint: float = 0.28,
    smallest: float = 3e-4,
    line_px: int = 2,
) -> np.ndarray:
    """Tint, outline and label (with their ids) what an id map (h, w) shows; the rest of the picture is paled.

    What covers less than `smallest` of the picture is left out. Without `line_px` there are no outlines.
    """
    height, width = image.shape[:2]
    ids = cv2.resize(ids.astype(np.uint16), (width, height), interpolation=cv2.INTER_NEAREST)
    picture = (0.5 * image + 0.5 * PAPER).astype(np.uint8)
    places = []
    for number in sorted(colors):
        mask = ids == number
        if mask.sum() < max(1, smallest * mask.size):
            continue
        smooth = cv2.medianBlur(mask.astype(np.uint8), 5)
        picture[mask] = ((1 - tint) * image[mask] + tint * np.array(colors[number])).astype(np.uint8)
        contours, _ = cv2.findContours(smooth, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        if line_px:
            cv2.drawContours(picture, contours, -1, (255, 255, 255), line_px + 1, cv2.LINE_AA)
            cv2.drawContours(picture, contours, -1, colors[number], line_px, cv2.LINE_AA)
        inner = cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
        row, column = np.unravel_index(int(np.argmax(inner)), inner.shape)
        places.append((number, int(column), int(row)))
    taken: list[tuple[float, float, float, float]] = []
    for number, column, row in places:
        text = (labels or {}).get(number, str(number))
        picture = badge(picture, text, column, row, colors[number], taken)
    return picture


def badge(
    image: np.ndarray,
    text: str,
    column: int,
    row: int,
    color: tuple[int, int, int],
    taken: list[tuple[float, float, float, float]],
) -> np.ndarray:
    """Write a short text in a colored pill near a pixel: inside the picture and, if it can, beside those in `taken`."""
    from PIL import Image, ImageDraw

    size = max(11, round(image.shape[1] / 44))
    picture = Image.fromarray(image)
    draw, bold = ImageDraw.Draw(picture), font(size)
    half, tall = draw.textlength(text, font=bold) / 2 + 0.36 * size, 0.68 * size
    column = int(np.clip(column, half + 1, image.shape[1] - half - 2))
    for shift in (0, -1, 1, -2, 2, -3, 3, 0):
        middle = int(np.clip(row + 2.05 * tall * shift, tall + 1, image.shape[0] - tall - 2))
        box = (column - half, middle - tall, column + half, middle + tall)
        if not any(box[0] < b[2] and b[0] < box[2] and box[1] < b[3] and b[1] < box[3] for b in taken):
            break
    taken.append(box)
    draw.rounded_rectangle(box, radius=0.5 * size, fill=color, outline=(255, 255, 255), width=1)
    dark = 0.3 * color[0] + 0.59 * color[1] + 0.11 * color[2] > 140
    draw.text((column, middle), text, font=bold, fill=(20, 22, 26) if dark else (255, 255, 255), anchor="mm")
    return np.asarray(picture)


@cache
def font(size: int, weight: str = "Bold") -> "ImageFont.FreeTypeFont":
    """Return a font that comes with matplotlib ("Bold", or "" for regular): pictures are the same everywhere."""
    import matplotlib
    from PIL import ImageFont

    name = f"DejaVuSans-{weight}" if weight else "DejaVuSans"
    return ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/{name}.ttf", size)
