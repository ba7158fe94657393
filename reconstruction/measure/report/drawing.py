"""Drawing helpers: color maps, normals, shading, outlines, badges, framing cameras, data URIs."""

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
_FAR = 40.0  # camera distance in radii of the framed points; nearly orthographic

Placed = tuple[TexturedMesh, np.ndarray]  # a mesh with its world_from_mesh


def data_uri(image: np.ndarray, quality: int = 82) -> str:
    """Encode an image uint8 RGB (h, w, 3) as a JPEG data URI."""
    flags = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    _, encoded = cv2.imencode(".jpg", cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2BGR), flags)
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()


def fit_width(image: np.ndarray, width: int) -> np.ndarray:
    """Downscale an image to at most this width."""
    if image.shape[1] <= width:
        return np.ascontiguousarray(image)
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return cv2.resize(np.asarray(image), (width, height), interpolation=cv2.INTER_AREA)


@cache
def color_table(name: str) -> np.ndarray:
    """Return a matplotlib color map as uint8 (256, 3)."""
    import matplotlib

    return (matplotlib.colormaps[name](np.linspace(0, 1, 256))[:, :3] * 255).round().astype(np.uint8)


def colorize(values: np.ndarray, low: float, high: float, name: str, known: np.ndarray) -> np.ndarray:
    """Map values (...) between two limits to colors uint8 (..., 3); gray where `known` is False."""
    level = np.clip((np.nan_to_num(values) - low) / max(high - low, 1e-9), 0, 1)
    picture = color_table(name)[(level * 255).round().astype(np.int64)]
    picture[~known] = UNKNOWN
    return picture


def gradient(name: str) -> str:
    """Return a matplotlib color map as a CSS gradient."""
    stops = color_table(name)[np.linspace(0, 255, 9).astype(int)]
    return "linear-gradient(90deg," + ",".join("#{:02x}{:02x}{:02x}".format(*c) for c in stops) + ")"


def object_color(rank: int) -> tuple[int, int, int]:
    """Return a color for the rank-th object; the golden ratio separates the hues of neighboring ranks."""
    hue = np.array([[[int(179 * ((0.07 + rank * 0.381966) % 1.0)), 175, 226]]], np.uint8)
    red, green, blue = cv2.cvtColor(hue, cv2.COLOR_HSV2RGB)[0, 0].tolist()
    return red, green, blue


def css_color(color: tuple[int, int, int]) -> str:
    """Return `#rrggbb`."""
    return "#{:02x}{:02x}{:02x}".format(*color)


def camera_normals(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Compute unit normals float32 (h, w, 3), in camera space towards the camera, of a z-depth map; 0 = unknown.

    Each derivative is the smaller of the forward and backward difference, so that depth edges do not affect it.
    """
    rays = camera.pixel_rays()
    points = rays * depth[..., None].astype(np.float64)

    def derivative(axis: int) -> tuple[np.ndarray, np.ndarray]:
        ahead = np.roll(points, -1, axis) - points
        valid = (depth > 0) & (np.roll(depth, -1, axis) > 0)
        np.moveaxis(valid, axis, 0)[-1] = False
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
    """Map unit normals (h, w, 3) to colors (n + 1) / 2, uint8; gray where they are zero."""
    picture = ((normals + 1) * 127.5).round().astype(np.uint8)
    picture[~normals.any(axis=2)] = UNKNOWN
    return picture


def shaded(picture: np.ndarray, depth: np.ndarray, camera: Camera, strength: float = 0.45) -> np.ndarray:
    """Shade an image with a headlight, from the normals of its z-depth; the background is unchanged."""
    slope = -camera_normals(depth, camera)[..., 2]
    light = np.where((depth > 0) & (slope > 0), 1 - strength * (1 - slope), 1.0)
    light = cv2.blur(light.astype(np.float32), (3, 3))[..., None]
    return np.where(depth[..., None] > 0, picture * light, picture).round().astype(np.uint8)


def render_ids(meshes: list[tuple[int, Placed]], camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Render the numbers of meshes: int32 (h, w), 0 = none."""
    ids, depth = (
        np.zeros((camera.height, camera.width), np.int32),
        np.full((camera.height, camera.width), np.inf),
    )
    for number, (mesh, world_from_mesh) in meshes:
        raster = rasterize_mesh(transform_points(world_from_mesh, mesh.vertices), mesh.faces, camera, pose)
        nearer = (raster.face >= 0) & (raster.depth < depth)
        depth[nearer], ids[nearer] = raster.depth[nearer], number
    return ids


def render_lit(meshes: list[Placed], camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Render textured meshes with a headlight."""
    picture, depth = render_textured(meshes, camera, pose)
    return shaded(picture, depth, camera)


def render_colored(
    vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray, camera: Camera, pose: np.ndarray
) -> np.ndarray:
    """Render a mesh with vertex colors (v, 3), 0..255, and a headlight; antialiased by 2x2 supersampling."""
    big = camera.resized(2 * camera.width, 2 * camera.height)
    raster: Raster = rasterize_mesh(vertices, faces, big, pose)
    picture = np.where(
        (raster.face >= 0)[..., None], raster.interpolate(faces, np.asarray(colors, np.float32)), BACKGROUND
    )
    picture = shaded(picture, raster.depth, big)
    return cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


def facing(vertices: np.ndarray, faces: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return which faces (f,) are front-facing for a camera."""
    a, b, c = (np.asarray(vertices, np.float64)[faces[:, k]] for k in range(3))
    return (np.cross(b - a, c - a) * (pose[:3, 3] - a)).sum(axis=1) > 0


def looking(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Return the rotation (3, 3) world_from_camera of an upright camera in that direction, looking at the origin."""
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
    """Return a distant, nearly orthographic camera that frames points (n, 3) from a direction, and its pose.

    Without `height` the image is as high as the points need, at most 1.2 times its width.
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
    """Tint, outline and label the objects of an id map (h, w); the rest of the image is lightened.

    Args:
        image: uint8 (h, w, 3).
        ids: of any size, resampled to the image.
        colors: id -> color; other ids are not drawn.
        labels: id -> text; the default is the id.
        tint: opacity of the color.
        smallest: least share of the image that an object covers.
        line_px: width of outlines; 0: none.
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
    """Draw a text badge near a pixel, inside the image and if possible not over the boxes `taken`; adds its box."""
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
    """Return DejaVu Sans ("Bold", or "" for regular) of matplotlib, so that images are the same on all machines."""
    import matplotlib
    from PIL import ImageFont

    name = f"DejaVuSans-{weight}" if weight else "DejaVuSans"
    return ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/{name}.ttf", size)
