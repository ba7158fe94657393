"""Draw the images of a report, one function per stage; callers check that the stage results exist."""

from collections.abc import Callable, Iterator

import cv2
import numpy as np

from reconstruction.core.types import Camera
from reconstruction.gaussians import Gaussians, render_gaussians
from reconstruction.measure.rendering import score_pictures
from reconstruction.measure.report import drawing, plots
from reconstruction.measure.report.blocks import Picture
from reconstruction.measure.report.collect import Gathered, present
from reconstruction.publish.preview import best_view, render_textured
from registry.geometry import invert_rigid, transform_points

FRAME_PX, THUMB_PX, VIEW_PX = 440, 240, 460  # widths of images
DEPTH_ERROR_M, MOVED_M, COLOR_ERROR = 0.10, 0.05, 64.0  # upper ends of color scales


def picture(image: np.ndarray, alt: str, caption: str = "", overlay: str = "", quality: int = 80) -> Picture:
    """Encode an image uint8 (h, w, 3) as a picture of the page."""
    height, width = image.shape[:2]
    return Picture(drawing.data_uri(image, quality), width, height, alt, caption, overlay)


def preview(g: Gathered) -> Picture | None:
    """Return the bundle's preview: a keyframe beside the assembled scene; None without one."""
    if "preview.png" not in g.bundle.files:
        return None
    image = cv2.imread(str(g.bundle.resolve("preview.png")))
    if image is None:
        return None
    text = "a frame of the video, and the assembled scene from the same camera"
    return picture(image[..., ::-1], text, quality=84)


def keyframes(g: Gathered, count: int = 12) -> list[Picture]:
    """Return thumbnails of keyframes."""
    posed, out = present(g.posed), []
    for row in g.keyframe_rows(count):
        index, time_s = int(posed.indices[row]), float(posed.times_s[row])
        caption = f"{index} · {time_s:.1f} s" if posed.ordered else str(index)
        out.append(_frame(np.asarray(posed.images[row]), f"frame {index}", caption, THUMB_PX))
    return out


def camera_path(g: Gathered) -> Picture:
    """Render the scene from above with the camera path."""
    cameras = g.bundle.cameras
    centers = cameras.world_from_camera[:, :3, 3]
    shown = [m for m in g.meshes if m.label != "ceiling"]
    points = np.concatenate([centers, *(m.vertices for m in shown)])
    camera, pose = drawing.framing_camera(points, -90.0, 89.9, 640, margin=0.06)
    image = drawing.render_lit([(m.visual, m.world_from_mesh) for m in shown], camera, pose)
    image = (0.72 * image + 0.28 * 255).astype(np.uint8)
    ahead = cameras.world_from_camera[:, :3, 2].copy()
    held_out = {f["index"]: f.get("held_out", False) for f in g.scene["cameras"]["frames"]}
    flat = project(centers, camera, pose)
    svg = plots.camera_path(
        flat,
        np.column_stack([ahead[:, 0], -ahead[:, 1]]),
        np.array([not held_out[int(i)] for i in cameras.indices]),
        (camera.width, camera.height),
    )
    return picture(image, "the scene from above with the camera's path", overlay=svg)


def depth_rows(g: Gathered, count: int = 4) -> tuple[list[Picture], list[float]]:
    """Draw color, depth, normals (and the depth error) of keyframes; also return median errors in metres."""
    posed, maps, out, errors = present(g.posed), present(g.depth), [], []
    compared = depth_is_compared(g, count)
    for row in g.keyframe_rows(count):
        index, depth = int(posed.indices[row]), np.asarray(maps.depth[row])
        pose = posed.world_from_camera[row]
        known = depth > 0
        near, far = np.percentile(depth[known], [2, 98]) if known.any() else (0.0, 1.0)
        normals = drawing.camera_normals(_denoised(depth), maps.camera) @ pose[:3, :3].T.astype(np.float32)
        confidence = np.asarray(maps.confidence[row])
        shares = f"{(confidence >= 2).mean():.0%} measured, {(confidence == 1).mean():.0%} completed"
        colored = drawing.colorize(depth, near, far, "turbo_r", known)
        out += [
            _frame(np.asarray(posed.images[row]), f"frame {index}", f"frame {index}"),
            _frame(colored, f"depth of frame {index}", f"{near:.1f} to {far:.1f} m; {shares}"),
            _frame(drawing.normal_colors(normals), f"normals of frame {index}"),
        ]
        if compared:
            drawn, median = _depth_error(g, index, pose, depth)
            out.append(drawn)
            errors += [] if median is None else [median]
    return out, errors


def depth_is_compared(g: Gathered, count: int = 4) -> bool:
    """Return whether the true depth of any of the drawn keyframes is known."""
    if g.truth is None:
        return False
    shown = [int(present(g.posed).indices[row]) for row in g.keyframe_rows(count)]
    return g.truth.has_meshes or any(g.truth.known.depth(index) is not None for index in shown)


def _depth_error(
    g: Gathered, index: int, pose: np.ndarray, depth: np.ndarray
) -> tuple[Picture, float | None]:
    truth = present(g.truth)
    true = truth.frame(index, pose, present(g.depth).camera)
    if true is None or not (true[0] > 0).any():
        blank = np.broadcast_to(drawing.UNKNOWN, (*depth.shape, 3))
        return _frame(blank, f"no true depth of frame {index}", "no true depth of this frame"), None
    known = (depth > 0) & (true[0] > 0)
    error = np.abs(depth * truth.alignment.scale - true[0])
    median = float(np.median(error[known])) if known.any() else None
    colored = drawing.colorize(error, 0, DEPTH_ERROR_M, drawing.ERROR_MAP, known)
    text = "nothing to compare" if median is None else f"median {100 * median:.1f} cm"
    return _frame(colored, f"depth error of frame {index}", text), median


def _denoised(depth: np.ndarray) -> np.ndarray:
    """Smooth a depth map bilaterally, for less noisy normals; unknown pixels stay unknown."""
    smooth = cv2.bilateralFilter(depth.astype(np.float32), 5, 0.03, 2.0)
    weight = cv2.blur((depth > 0).astype(np.float32), (5, 5))
    return np.where((depth > 0) & (weight > 0.999), smooth, depth).astype(np.float32)


def _frame(image: np.ndarray, alt: str, caption: str = "", width: int = FRAME_PX) -> Picture:
    return picture(drawing.fit_width(image, width), alt, caption)


def instance_frames(g: Gathered, count: int = 6) -> list[Picture]:
    """Draw keyframes with outlined instances; beside each the true instances, if known."""
    posed, instances, out = present(g.posed), present(g.instances), []
    for row in _instance_rows(g, count):
        index = int(posed.indices[row])
        image = drawing.fit_width(np.asarray(posed.images[row]), FRAME_PX + 60)
        found = drawing.outlined(image, np.asarray(instances.id_maps[row]), g.colors)
        out.append(picture(found, f"instances in frame {index}", f"frame {index}"))
        if g.truth is not None and g.truth.has_meshes:
            out.append(_true_instances(g, index, row, image))
    return out


def _instance_rows(g: Gathered, count: int) -> list[int]:
    """Return the keyframes of the contact sheets, or evenly spaced ones if the bundle names none."""
    rows = {int(index): row for row, index in enumerate(present(g.posed).indices)}
    named = [f["index"] for f in g.scene.get("instances", {"frames": []})["frames"]]
    return [rows[index] for index in named if index in rows] or g.keyframe_rows(count)


def _true_instances(g: Gathered, index: int, row: int, image: np.ndarray) -> Picture:
    posed, truth = present(g.posed), present(g.truth)
    camera = posed.camera.resized(image.shape[1], image.shape[0])
    _, ids = present(truth.frame(index, posed.world_from_camera[row], camera))
    ids = present(ids)  # the truth has meshes
    found_for = {o["true_id"]: o["match"] for o in (g.evaluation or {}).get("objects", [])}
    colors, labels, missed = {}, {}, []
    for entity in truth.known.entities:
        match = found_for.get(entity.id)
        if entity.base:
            continue
        colors[entity.id] = (214, 40, 57) if match is None else g.colors.get(match, (214, 40, 57))
        labels[entity.id] = str(match) if match is not None else "✕"
        if match is None and entity.id in found_for and (ids == entity.id).sum() > 3e-4 * ids.size:
            missed.append(entity.name.replace("_", " "))
    text = "the truth" + (f"; missed: {', '.join(missed)}" if missed else "")
    return picture(drawing.outlined(image, ids, colors, labels), f"true instances in frame {index}", text)


def project(points: np.ndarray, camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Project world points (n, 3) to pixels (n, 2); NaN behind the camera."""
    local = transform_points(invert_rigid(pose), points)
    local[:, 2] = np.where(local[:, 2] > 1e-3, local[:, 2], np.nan)
    return np.column_stack(camera.project(local))


def assembly_view(g: Gathered) -> tuple[list[Picture], Picture | None]:
    """Draw a frame and the scene before and after assembly at its camera; and the displacement of each object."""
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
        out.append(picture(image, "the scene before assembly", "before: estimated poses"))
    image, _ = render_textured([(m.visual, m.world_from_mesh) for m in g.meshes], camera, pose)
    out.append(picture(image, "the scene after assembly", "after: at rest"))
    return out, _moved_view(g, image, camera, pose)


def _moved_view(g: Gathered, image: np.ndarray, camera: Camera, pose: np.ndarray) -> Picture | None:
    moved = {o["id"]: o["assembly"]["moved_m"] for o in g.objects if "assembly" in o}
    if not moved:
        return None
    ids = drawing.render_ids([(m.id, (m.visual, m.world_from_mesh)) for m in g.meshes], camera, pose)
    levels = drawing.colorize(np.array(list(moved.values())), 0, MOVED_M, "YlOrRd", np.ones(len(moved), bool))
    colors = {item: (int(red), int(green), int(blue)) for item, (red, green, blue) in zip(moved, levels)}
    labels = {item: f"{item}: {100 * metres:.1f}" for item, metres in moved.items()}
    gray = np.repeat(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2)
    drawn = drawing.outlined(gray, ids, colors, labels, tint=0.6)
    return picture(drawn, "how far each object was moved", "moved by assembly, in cm")


# Renders one representation of the scene at a camera: image uint8 (h, w, 3), mask bool (h, w) of covered pixels.
Renderer = Callable[[Camera, np.ndarray], tuple[np.ndarray, np.ndarray]]


def renderers(g: Gathered) -> dict[str, Renderer]:
    """Return the renderers of all available representations of the scene by name, in display order."""
    meshes = [(m.visual, m.world_from_mesh) for m in g.meshes]

    def scene(camera: Camera, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        image, depth = render_textured(meshes, camera, pose)
        return image, depth > 0

    def gaussians(camera: Camera, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        render = render_gaussians(present(g.gaussians), camera, pose)
        return render.uint8(), render.opacity > 0.5

    return {"scene": scene} if g.gaussians is None else {"Gaussians": gaussians, "scene": scene}


def draw_gaussians(
    gaussians: Gaussians, camera: Camera, pose: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[float, float]]:
    """Render color, depth and normals (world axes) as images; also return the depth limits (near, far)."""
    render = render_gaussians(gaussians, camera, pose)
    solid = render.opacity > 0.5
    near, far = np.percentile(render.depth[solid], [2, 98]) if solid.any() else (0.0, 1.0)
    normals = render.normal / np.maximum(np.linalg.norm(render.normal, axis=2, keepdims=True), 1e-6)
    normals = np.where(solid[..., None], normals @ pose[:3, :3].T.astype(np.float32), 0)
    depth = drawing.colorize(render.depth, near, far, "turbo_r", solid)
    return render.uint8(), depth, drawing.normal_colors(normals), (float(near), float(far))


def gaussian_rows(g: Gathered, count: int = 3) -> list[Picture]:
    """Draw held-out frames with color, depth and normals of the Gaussians at their cameras."""
    out = []
    for index, frame, camera, pose in _held_out_views(g, count):
        color, depth, normals, (near, far) = draw_gaussians(present(g.gaussians), camera, pose)
        out += [
            _frame(frame, f"held-out frame {index}", f"frame {index}"),
            picture(color, f"color of the Gaussians, frame {index}"),
            picture(depth, f"depth of the Gaussians, frame {index}", f"{near:.1f} to {far:.1f} m"),
            picture(normals, f"normals of the Gaussians, frame {index}"),
        ]
    return out


def _held_out_views(g: Gathered, count: int) -> Iterator[tuple[int, np.ndarray, Camera, np.ndarray]]:
    """Yield index, image, camera of width FRAME_PX, and pose of evenly spaced held-out frames."""
    posed = present(g.posed)
    total = len(posed.held_out_indices)
    camera = posed.camera.resized(FRAME_PX, round(FRAME_PX * posed.camera.height / posed.camera.width))
    for row in (int((k + 0.5) * total / min(count, total)) for k in range(min(count, total))):
        image, pose = np.asarray(posed.held_out_images[row]), posed.held_out_world_from_camera[row]
        yield int(posed.held_out_indices[row]), image, camera, pose


def held_out_frames(
    g: Gathered, renderers: dict[str, Renderer], count: int = 4
) -> tuple[list[Picture], dict[str, list[tuple[float, float, float]]]]:
    """Draw held-out frames, each rendering and its color error; also return (PSNR, SSIM, coverage) per renderer."""
    out = []
    scores: dict[str, list[tuple[float, float, float]]] = {name: [] for name in renderers}
    for index, frame, camera, pose in _held_out_views(g, count):
        frame = cv2.resize(frame, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        out.append(picture(frame, f"held-out frame {index}", f"frame {index}"))
        for name, render in renderers.items():
            image, covered = render(camera, pose)
            score = score_pictures([image], [covered], [frame])
            text = "no pixel covered"
            if score is not None:
                scores[name].append((score.psnr_db, score.ssim, score.coverage))
                text = f"{score.psnr_db:.1f} dB over {score.coverage:.0%}"
            error = np.abs(image.astype(np.float32) - frame).mean(axis=2)
            error = drawing.colorize(error, 0, COLOR_ERROR, drawing.ERROR_MAP, covered)
            out.append(picture(image, f"the {name} at the camera of frame {index}"))
            out.append(picture(error, f"color error of the {name}, frame {index}", text))
    return out, scores
