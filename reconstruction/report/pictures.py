"""The pictures of a report: each function draws those of one stage from what was gathered."""

from dataclasses import replace

import cv2
import numpy as np

from reconstruction.evaluation.scene import PlacedMesh, joined
from reconstruction.evaluation.surfaces import sample
from reconstruction.preview import best_view, render_textured
from reconstruction.rasterize import rasterize_mesh
from reconstruction.report import drawing, plots
from reconstruction.report.blocks import Picture
from reconstruction.report.collect import Gathered
from reconstruction.report.truth import NearSurface
from reconstruction.types import Camera, Surface, TexturedMesh
from registry.geometry import invert_rigid, transform_points

ANGLES = 12
_TURNTABLE_PX = 190
FRAME_PX, THUMB_PX, VIEW_PX = 440, 240, 460
DEPTH_ERROR_M, SURFACE_ERROR_M, MOVED_M, COLOR_ERROR = 0.10, 0.05, 0.05, 64.0


def picture(image: np.ndarray, alt: str, caption: str = "", overlay: str = "", quality: int = 80) -> Picture:
    """Wrap pixels as a picture of the page."""
    height, width = image.shape[:2]
    return Picture(drawing.data_uri(image, quality), width, height, alt, caption, overlay)


def preview(g: Gathered) -> Picture | None:
    """The bundle's own preview: a keyframe beside the assembled scene."""
    if "preview.png" not in g.bundle.files:
        return None
    image = cv2.imread(str(g.bundle.resolve("preview.png")))
    if image is None:
        return None
    text = "a frame of the video, and the assembled scene from the same camera"
    return picture(image[..., ::-1], text, quality=84)


def keyframes(g: Gathered, count: int = 12) -> list[Picture]:
    """A strip of keyframes."""
    out = []
    for row in g.keyframe_rows(count):
        index, time_s = int(g.posed.indices[row]), float(g.posed.times_s[row])
        image = drawing.fit_width(np.asarray(g.posed.images[row]), THUMB_PX)
        out.append(
            picture(image, f"frame {index}", f"{index} · {time_s:.1f} s" if g.posed.ordered else str(index))
        )
    return out


def camera_path(g: Gathered) -> Picture:
    """The scene from above with the camera's path."""
    cameras = g.bundle.cameras
    centers = cameras.world_from_camera[:, :3, 3]
    shown = [m for m in g.meshes if m.label != "ceiling"]
    points = np.concatenate([centers, *(m.vertices for m in shown)])
    camera, pose = drawing.framing_camera(points, -90.0, 89.9, 640, margin=0.06)
    image = drawing.render_lit([(m.visual, m.world_from_mesh) for m in shown], camera, pose)
    image = (0.72 * image + 0.28 * 255).astype(np.uint8)
    ahead = cameras.world_from_camera[:, :3, 2].copy()
    held_out = {f["index"]: f.get("held_out", False) for f in g.scene["cameras"]["frames"]}
    flat = _project(centers, camera, pose)
    svg = plots.camera_path(
        flat,
        np.column_stack([ahead[:, 0], -ahead[:, 1]]),
        np.array([not held_out[int(i)] for i in cameras.indices]),
        (camera.width, camera.height),
    )
    return picture(image, "the scene from above with the camera's path", overlay=svg)


def depth_rows(g: Gathered, count: int = 4) -> tuple[list[Picture], list[float]]:
    """Color, depth, normals (and the error against the truth) of some keyframes; median errors in metres."""
    out, errors = [], []
    camera = g.depth.camera
    for row in g.keyframe_rows(count):
        index, depth = int(g.posed.indices[row]), np.asarray(g.depth.depth[row])
        pose = g.posed.world_from_camera[row]
        known = depth > 0
        near, far = np.percentile(depth[known], [2, 98]) if known.any() else (0.0, 1.0)
        normals = drawing.camera_normals(_denoised(depth), camera) @ pose[:3, :3].T.astype(np.float32)
        confidence = np.asarray(g.depth.confidence[row])
        shares = f"{(confidence >= 2).mean():.0%} measured, {(confidence == 1).mean():.0%} completed"
        colored = drawing.colorize(depth, near, far, "turbo_r", known)
        out += [
            _frame(np.asarray(g.posed.images[row]), f"frame {index}", f"frame {index}"),
            _frame(colored, f"depth of frame {index}", f"{near:.1f} to {far:.1f} m; {shares}"),
            _frame(drawing.normal_colors(normals), f"normals of frame {index}"),
        ]
        if g.truth is not None:
            drawn, median = _depth_error(g, index, pose, depth)
            out.append(drawn)
            errors += [] if median is None else [median]
    return out, errors


def _depth_error(
    g: Gathered, index: int, pose: np.ndarray, depth: np.ndarray
) -> tuple[Picture, float | None]:
    true = g.truth.frame(index, pose, g.depth.camera)
    if true is None or not (true[0] > 0).any():
        blank = np.broadcast_to(drawing.UNKNOWN, (*depth.shape, 3))
        return _frame(blank, f"no true depth of frame {index}", "no true depth of this frame"), None
    known = (depth > 0) & (true[0] > 0)
    error = np.abs(depth * g.truth.alignment.scale - true[0])
    median = float(np.median(error[known])) if known.any() else None
    colored = drawing.colorize(error, 0, DEPTH_ERROR_M, drawing.ERROR_MAP, known)
    text = "nothing to compare" if median is None else f"median {100 * median:.1f} cm"
    return _frame(colored, f"depth error of frame {index}", text), median


def _denoised(depth: np.ndarray) -> np.ndarray:
    """Smooth a depth map within surfaces for the look of its normals; what is unknown stays unknown."""
    smooth = cv2.bilateralFilter(depth.astype(np.float32), 5, 0.03, 2.0)
    weight = cv2.blur((depth > 0).astype(np.float32), (5, 5))
    return np.where((depth > 0) & (weight > 0.999), smooth, depth).astype(np.float32)


def _frame(image: np.ndarray, alt: str, caption: str = "", width: int = FRAME_PX) -> Picture:
    return picture(drawing.fit_width(image, width), alt, caption)


def side_views(g: Gathered, width: int = VIEW_PX) -> list[tuple[str, Camera, np.ndarray]]:
    """Three far cameras around the scene: where the video was taken from, and to both sides of that."""
    things = [m.vertices for m in g.object_meshes] or [m.vertices for m in g.meshes]
    points = np.concatenate([_box(v) for v in things])
    floor = [m for m in g.meshes if m.label == "floor"]
    for mesh in floor:  # as much floor as lies around the things
        low, high = points.min(axis=0) - 0.4, points.max(axis=0) + 0.4
        inside = np.clip(_box(mesh.vertices), low, high)
        points = np.concatenate([points, inside])
    center = points.mean(axis=0)
    toward = g.bundle.cameras.world_from_camera[:, :3, 3].mean(axis=0) - center
    azimuth = float(np.degrees(np.arctan2(toward[1], toward[0])))
    out = []
    for name, turn in (("from the left", -55.0), ("from the video's side", 0.0), ("from the right", 55.0)):
        out.append((name, *drawing.framing_camera(points, azimuth + turn, 32.0, width, round(0.8 * width))))
    return out


def _box(vertices: np.ndarray) -> np.ndarray:
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )


def surface_faces(g: Gathered, surface: Surface, pose: np.ndarray) -> np.ndarray:
    """Return the surface's faces without floor and walls that turn their back to a camera."""
    faces = np.asarray(surface.faces)
    front = drawing.facing(surface.vertices, faces, pose)
    if g.instances is None:
        return faces[front]
    base = np.isin(g.instances.vertex_instance, [item.id for item in g.instances.base])
    return faces[front | ~base[faces].any(axis=1)]


def surface_views(g: Gathered) -> tuple[list[Picture], list[str]]:
    """The fused surface from three sides: in color, as clay, and by its distance from the truth."""
    surface, views = g.surface, side_views(g)
    vertices = np.asarray(surface.vertices)
    clay = np.full((len(vertices), 3), 196, np.float32)
    out = []
    for what, colors in (("in color", np.asarray(surface.colors)), ("its shape alone", clay)):
        for name, camera, pose in views:
            faces = surface_faces(g, surface, pose)
            image = drawing.render_colored(vertices, faces, colors, camera, pose)
            out.append(picture(image, f"the surface {name}, {what}", what))
    if g.truth is not None and g.truth.has_meshes:
        for name, camera, pose in views:
            image, median = error_view(g, vertices, surface_faces(g, surface, pose), camera, pose)
            out.append(picture(image, f"surface error {name}", f"error, median {100 * median:.1f} cm"))
    return out, [name for name, _, _ in views]


def error_view(
    g: Gathered, vertices: np.ndarray, faces: np.ndarray, camera: Camera, pose: np.ndarray
) -> tuple[np.ndarray, float]:
    """Draw a mesh in the colors of its distance to the true surface; also return the median distance in metres."""
    raster = rasterize_mesh(vertices, faces, camera, pose)
    hit = raster.face >= 0
    distance = np.zeros(hit.shape)
    distance[hit] = g.truth.distance(raster.interpolate(faces, vertices)[hit])
    return _error_colors(distance, hit, raster.depth, camera), float(
        np.median(distance[hit])
    ) if hit.any() else 0.0


def missing_view(
    g: Gathered, near: NearSurface, camera: Camera, pose: np.ndarray
) -> tuple[np.ndarray, float]:
    """Draw the true surface in the colors of its distance to the scene, where the video shows it at all."""
    vertices, faces = g.truth.mesh_in_scene
    owners = np.concatenate([np.full(len(e.mesh.faces), e.base) for e in g.truth.known.entities])
    faces = faces[~owners | drawing.facing(vertices, faces, pose)]
    raster = rasterize_mesh(vertices, faces, camera, pose)
    hit = raster.face >= 0
    points = g.truth.alignment.to_true(raster.interpolate(faces, vertices)[hit])
    seen = g.truth.seen(points)
    distance, known = np.zeros(hit.shape), np.zeros(hit.shape, bool)
    distance[hit], known[hit] = near.distance(points), seen
    return _error_colors(distance, known, raster.depth, camera), float(
        np.median(distance[known])
    ) if seen.any() else 0.0


def _error_colors(distance: np.ndarray, known: np.ndarray, depth: np.ndarray, camera: Camera) -> np.ndarray:
    image = drawing.colorize(distance, 0, SURFACE_ERROR_M, drawing.ERROR_MAP, known)
    image[depth <= 0] = drawing.BACKGROUND
    return drawing.shaded(image, depth, camera)


def instance_frames(g: Gathered, count: int = 6) -> list[Picture]:
    """Keyframes with what was found in them; beside each the true outlines, where they are known."""
    out = []
    for row in g.keyframe_rows(count):
        index = int(g.posed.indices[row])
        image = drawing.fit_width(np.asarray(g.posed.images[row]), FRAME_PX + 60)
        found = drawing.outlined(image, np.asarray(g.instances.id_maps[row]), g.colors)
        out.append(picture(found, f"instances in frame {index}", f"frame {index}"))
        if g.truth is not None and g.truth.has_meshes:
            out.append(_true_instances(g, index, row, image))
    return out


def _true_instances(g: Gathered, index: int, row: int, image: np.ndarray) -> Picture:
    camera = g.posed.camera.resized(image.shape[1], image.shape[0])
    _, ids = g.truth.frame(index, g.posed.world_from_camera[row], camera)
    found_for = {o["true_id"]: o["match"] for o in (g.evaluation or {}).get("objects", [])}
    colors, labels, missed = {}, {}, []
    for entity in g.truth.known.entities:
        match = found_for.get(entity.id)
        if entity.base:
            continue
        colors[entity.id] = g.colors.get(match, (214, 40, 57))
        labels[entity.id] = str(match) if match is not None else "✕"
        if match is None and entity.id in found_for and (ids == entity.id).sum() > 3e-4 * ids.size:
            missed.append(entity.name.replace("_", " "))
    text = "the truth" + (f"; missed: {', '.join(missed)}" if missed else "")
    return picture(drawing.outlined(image, ids, colors, labels), f"true instances in frame {index}", text)


def turntable(g: Gathered, mesh: PlacedMesh, first_view: int | None) -> Picture:
    """Draw an object from twelve angles in one strip, beginning with where its best view looked from."""
    vertices = np.asarray(mesh.visual.vertices, np.float64)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    center = (low + high) / 2
    reach = max(float(np.hypot(*(vertices - center)[:, :2].T).max()), 1e-3)
    tall = max(float(high[2] - low[2]), 1e-3)
    elevation, start = 20.0, 0.0
    if first_view in g.poses:
        local = invert_rigid(mesh.world_from_mesh) @ g.poses[first_view][:, 3]
        start = float(np.degrees(np.arctan2(local[1] - center[1], local[0] - center[0])))
    up = tall * np.cos(np.radians(elevation)) + 2 * reach * np.sin(np.radians(elevation))
    box = max(2 * reach, up) * 1.08
    strip = []
    for k in range(ANGLES):
        azimuth = start + 360 * k / ANGLES
        camera, pose = drawing.framing_camera(
            center + 0.5 * box * _CROSS @ drawing.looking(azimuth, elevation).T, azimuth, elevation,
            _TURNTABLE_PX, _TURNTABLE_PX, margin=0.0,
        )  # fmt: skip
        strip.append(drawing.render_lit([(mesh.visual, np.eye(4))], camera, pose))
    image = np.hstack(strip)
    return picture(image, f"{mesh.label} {mesh.id} from twelve angles", quality=76)


# A square of unit half-width in a camera's image plane: what a turntable frames, whatever the object's shape.
_CROSS = np.array([[-1.0, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0]])


def object_views(g: Gathered, mesh: PlacedMesh, views: list[int], count: int = 4) -> list[Picture]:
    """Crop the frames that textured an object around it; its outline is where it was found."""
    if g.posed is None or g.seen_poses is None or mesh.id not in g.seen_poses:
        return []
    rows = {int(i): row for row, i in enumerate(g.posed.indices)}
    vertices = transform_points(g.seen_poses[mesh.id], mesh.visual.vertices)
    out = []
    for index in [v for v in views if v in rows][:count]:
        row = rows[index]
        box = _crop_box(_project(vertices, g.posed.camera, g.posed.world_from_camera[row]), g.posed.camera)
        if box is None:
            continue
        x0, y0, x1, y1 = box
        image = np.asarray(g.posed.images[row])[y0:y1, x0:x1].copy()
        if g.instances is not None:
            size = (g.posed.camera.width, g.posed.camera.height)
            mask = (np.asarray(g.instances.id_maps[row]) == mesh.id).astype(np.uint8)
            mask = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)[y0:y1, x0:x1]
            contours, _ = cv2.findContours(np.ascontiguousarray(mask), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
            thick = max(1, round((x1 - x0) / 110))
            cv2.drawContours(image, contours, -1, g.colors[mesh.id], thick, cv2.LINE_AA)
        out.append(picture(_resized_to(image, 150), f"{mesh.label} {mesh.id} in frame {index}", str(index)))
    return out


def _crop_box(pixels: np.ndarray, camera: Camera) -> tuple[int, int, int, int] | None:
    inside = np.isfinite(pixels).all(axis=1)
    if not inside.any():
        return None
    low, high = pixels[inside].min(axis=0), pixels[inside].max(axis=0)
    half = max(0.62 * float((high - low).max()), 24.0)
    center = (low + high) / 2
    x0, y0 = np.floor(np.maximum(center - half, 0)).astype(int)
    x1, y1 = np.ceil(np.minimum(center + half, [camera.width, camera.height])).astype(int)
    return None if x1 - x0 < 8 or y1 - y0 < 8 else (x0, y0, x1, y1)


def _resized_to(image: np.ndarray, side: int) -> np.ndarray:
    """Scale a crop so that it fits a square, up or down, and center it there."""
    scale = side / max(image.shape[:2])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    out = np.broadcast_to(drawing.BACKGROUND, (side, side, 3)).copy()
    y, x = (side - size[1]) // 2, (side - size[0]) // 2
    out[y : y + size[1], x : x + size[0]] = cv2.resize(image, size, interpolation=method)
    return out


def _project(points: np.ndarray, camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Return pixels (n, 2) of world points; NaN behind the camera."""
    local = transform_points(invert_rigid(pose), points)
    z = np.where(local[:, 2] > 1e-3, local[:, 2], np.nan)
    return np.column_stack([camera.fx * local[:, 0] / z + camera.cx, camera.fy * local[:, 1] / z + camera.cy])


def assembly_view(g: Gathered) -> tuple[list[Picture], Picture | None]:
    """A frame, the scene as seen and as placed from the same camera; and how far each object was moved."""
    posed, size = g.posed, (VIEW_PX + 60)
    camera = g.camera.resized(size, round(size * g.camera.height / g.camera.width))
    if posed is not None and g.assembled is not None:
        row = best_view(g.assembled, posed, camera)
        index = int(posed.indices[row])
    else:
        index = g.keyframe_indices[len(g.keyframe_indices) // 2]
    pose = g.poses[index]
    out = []
    if posed is not None:
        row = int(np.flatnonzero(posed.indices == index)[0])
        out.append(_frame(np.asarray(posed.images[row]), f"frame {index}", f"frame {index}", size))
    if g.seen_poses is not None:
        before = [
            (m.visual, m.world_from_mesh if m.base else g.seen_poses.get(m.id, m.world_from_mesh))
            for m in g.meshes
        ]
        image, _ = render_textured(before, camera, pose)
        out.append(picture(image, "the scene before assembly", "before: where each object was seen"))
    image, _ = render_textured([(m.visual, m.world_from_mesh) for m in g.meshes], camera, pose)
    out.append(picture(image, "the scene after assembly", "after: at rest"))
    return out, _moved_view(g, image, camera, pose)


def _moved_view(g: Gathered, image: np.ndarray, camera: Camera, pose: np.ndarray) -> Picture | None:
    moved = {o["id"]: o["assembly"]["moved_m"] for o in g.objects if "assembly" in o}
    if not moved:
        return None
    ids = drawing.render_ids([(m.id, (m.visual, m.world_from_mesh)) for m in g.meshes], camera, pose)
    levels = drawing.colorize(np.array(list(moved.values())), 0, MOVED_M, "YlOrRd", np.ones(len(moved), bool))
    colors = {item: tuple(int(x) for x in level) for item, level in zip(moved, levels)}
    labels = {item: f"{item}: {100 * metres:.1f}" for item, metres in moved.items()}
    gray = np.repeat(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2)
    drawn = drawing.outlined(gray, ids, colors, labels, tint=0.6)
    return picture(drawn, "how far each object was moved", "moved by assembly, in cm")


def scene_views(g: Gathered) -> list[Picture]:
    """The assembled scene from three sides; with a truth also its error, and what of the truth it lacks."""
    views = side_views(g)
    out = []
    for name, camera, pose in views:
        meshes = [(_open_room(m, pose), m.world_from_mesh) for m in g.meshes]
        out.append(picture(drawing.render_lit(meshes, camera, pose), f"the scene {name}", name))
    if g.truth is None or not g.truth.has_meshes:
        return out
    for _, camera, pose in views:
        shown = [replace(m, faces=_open_room(m, pose).faces) for m in g.meshes]
        image, median = error_view(g, *joined(shown), camera, pose)
        out.append(
            picture(image, "scene error", f"the scene's distance to the truth, median {100 * median:.1f} cm")
        )
    vertices, faces = joined(g.meshes)
    near = NearSurface(sample(g.truth.alignment.to_true(vertices), faces, 400_000))
    for _, camera, pose in views:
        image, median = missing_view(g, near, camera, pose)
        text = f"the truth's distance to the scene, median {100 * median:.1f} cm"
        out.append(picture(image, "what of the truth is missing", text))
    return out


def _open_room(mesh: PlacedMesh, pose: np.ndarray) -> TexturedMesh:
    """Return a mesh without the walls that stand between the camera and the room."""
    if not mesh.base:
        return mesh.visual
    return replace(mesh.visual, faces=mesh.faces[drawing.facing(mesh.vertices, mesh.faces, pose)])


def kept_out_frames(g: Gathered, count: int = 4) -> tuple[list[Picture], list[tuple[float, float, float]]]:
    """Kept-out frames beside the scene at their cameras and the difference; PSNR, SSIM and coverage of each."""
    from reconstruction.evaluation.rendering import render_views, score_pictures

    posed, out, scores = g.posed, [], []
    total = len(posed.held_out_indices)
    rows = [int((k + 0.5) * total / min(count, total)) for k in range(min(count, total))]
    camera = posed.camera.resized(FRAME_PX, round(FRAME_PX * posed.camera.height / posed.camera.width))
    meshes = [(m.visual, m.world_from_mesh) for m in g.meshes]
    for row in rows:
        frame = cv2.resize(
            np.asarray(posed.held_out_images[row]),
            (camera.width, camera.height),
            interpolation=cv2.INTER_AREA,
        )
        (image,), (covered,) = render_views(meshes, camera, [posed.held_out_world_from_camera[row]])
        score = score_pictures([image], [covered], [frame])
        difference = np.abs(image.astype(np.float32) - frame).mean(axis=2)
        index = int(posed.held_out_indices[row])
        text = "nothing covered"
        if score is not None:
            scores.append((score.psnr_db, score.ssim, score.coverage))
            text = f"{score.psnr_db:.1f} dB over {score.coverage:.0%}"
        drawn = drawing.colorize(difference, 0, COLOR_ERROR, drawing.ERROR_MAP, covered)
        out += [
            picture(frame, f"kept-out frame {index}", f"kept-out frame {index}"),
            picture(image, f"the scene at the camera of frame {index}", "the scene"),
            picture(drawn, f"color error of frame {index}", text),
        ]
    return out, scores
