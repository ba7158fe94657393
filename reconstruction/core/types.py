"""Artifacts that stages exchange: frozen dataclasses of NumPy arrays and plain values, in the order of the data flow.

Conventions (docs/conventions.md): transforms are `b_from_a`, float64 4x4. Camera frames are OpenCV: +x right, +y down,
+z forward. `sfm` space has arbitrary scale and orientation. `world` is in metres, +z up, floor at z = 0. Images are
sRGB. Depth is z-depth, 0 = unknown. The centre of the first pixel is (0.5, 0.5). Instance ids are integers >= 1 with
one meaning in all artifacts; 0 = none. Quaternions are wxyz. Annotations give dtype and axes of arrays, as in
`CheckedArrays`. `reconstruction.core.artifacts` saves and loads artifacts.
"""

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from reconstruction.core.checked_arrays import CheckedArrays
from reconstruction.core.reflections import without_reflections
from registry.geometry import split_similarity, transform_points
from registry.labels import STRUCTURE


@dataclass(frozen=True)
class VideoSource:
    """The video file that frames were decoded from."""

    file: str
    sha256: str
    width: int  # pixels
    height: int  # pixels
    fps: float
    frame_count: int
    duration_s: float


@dataclass(frozen=True)
class FrameSet(CheckedArrays):
    """Stage 1: n keyframes and m held-out frames, upright, at working resolution."""

    source: VideoSource
    images: Annotated[np.ndarray, "uint8 n h w 3"]  # RGB keyframes in time order
    indices: Annotated[np.ndarray, "int32 n"]  # decoded video frame numbers
    times_s: Annotated[np.ndarray, "float64 n"]
    sharpness: Annotated[np.ndarray, "float32 n"]  # larger is sharper; comparable within one video only
    held_out_images: Annotated[np.ndarray, "uint8 m h w 3"]  # index % 10 == 0, for evaluation only
    held_out_indices: Annotated[np.ndarray, "int32 m"]  # decoded video frame numbers; disjoint from `indices`
    held_out_times_s: Annotated[np.ndarray, "float64 m"]
    focal_prior_px: float  # focal length from metadata, 0 = unknown
    ordered: bool  # True: video; False: image folder, where neighbours in name order may be far apart
    quarter_turns: int = 0  # counter-clockwise, from frames as stored in the file to upright


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion; all values in pixels, the centre of the first pixel is (0.5, 0.5)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def matrix(self) -> np.ndarray:
        """Return the intrinsic matrix K, float64 (3, 3)."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def resized(self, width: int, height: int) -> "Camera":
        """Return the camera of the same view at another resolution, in pixels."""
        sx, sy = width / self.width, height / self.height
        return Camera(width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy)

    @property
    def intrinsics(self) -> np.ndarray:
        """Return fx, fy, cx, cy as float64 (4,), for compiled kernels."""
        return np.array([self.fx, self.fy, self.cx, self.cy], np.float64)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project points (..., 3) from the camera frame; return columns and rows (...), in pixels.

        Points with z <= 0 are not checked: their result has no meaning.
        """
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        return self.fx * x / z + self.cx, self.fy * y / z + self.cy

    def unproject(
        self, columns: np.ndarray | float, rows: np.ndarray | float, z: np.ndarray | float
    ) -> np.ndarray:
        """Return the points (..., 3) at pixels, in the camera frame and the units of `z`.

        Args:
            columns: pixel coordinates, the centre of the first pixel is 0.5.
            rows: the same.
            z: z-depth; 1 gives rays.
        """
        x, y = (columns - self.cx) / self.fx * z, (rows - self.cy) / self.fy * z
        return np.stack(np.broadcast_arrays(x, y, z), axis=-1)

    def pixel_rays(self) -> np.ndarray:
        """Return the rays through all pixel centres, float64 (height, width, 3), with z = 1."""
        columns, rows = np.arange(self.width) + 0.5, np.arange(self.height) + 0.5
        return self.unproject(columns[None, :], rows[:, None], np.ones((self.height, self.width)))


@dataclass(frozen=True)
class DistortedCamera(CheckedArrays):
    """A camera with lens distortion, in COLMAP's terms; pixels as in `Camera`."""

    model: str  # COLMAP's name: "SIMPLE_RADIAL", "RADIAL", "OPENCV", …
    width: int
    height: int
    params: Annotated[np.ndarray, "float64 k"]  # focal lengths, principal point, distortion


@dataclass(frozen=True)
class PosedFrames(CheckedArrays):
    """Stage 2: undistorted frames with cameras and sparse points, in `sfm` space; `WorldFrame.apply_to` moves them."""

    source: VideoSource
    camera: Camera  # shared by all frames, at the resolution of `images`
    images: Annotated[np.ndarray, "uint8 n h w 3"]  # RGB keyframes
    indices: Annotated[np.ndarray, "int32 n"]  # decoded video frame numbers
    times_s: Annotated[np.ndarray, "float64 n"]
    world_from_camera: Annotated[np.ndarray, "float64 n 4 4"]  # rigid
    sharpness: Annotated[np.ndarray, "float32 n"]  # as in `FrameSet`
    held_out_images: Annotated[np.ndarray, "uint8 m h w 3"]  # RGB; only frames that could be registered
    held_out_indices: Annotated[np.ndarray, "int32 m"]  # decoded video frame numbers
    held_out_times_s: Annotated[np.ndarray, "float64 m"]
    held_out_world_from_camera: Annotated[np.ndarray, "float64 m 4 4"]  # rigid
    points: Annotated[np.ndarray, "float64 p 3"]  # sparse points
    point_colors: Annotated[np.ndarray, "uint8 p 3"]  # RGB
    point_errors_px: Annotated[np.ndarray, "float32 p"]  # mean reprojection error
    observations: Annotated[np.ndarray, "int32 o 2"]  # pairs (frame row, point row): the frame sees the point
    chosen_frames: int  # keyframes before registration; len(images) / chosen_frames is the registered share
    ordered: bool  # rows are in time order
    reprojection_error_px: float  # mean
    metric: bool = False  # `sfm` is in metres: poses were imported from a metric tracker (ARKit)
    distorted: DistortedCamera | None = None  # of the recorded frames, at this size; None: `camera` is theirs
    # pixels, of the recorded frames' principal points, keyframes first, then held-out ones; None: a crop does not move
    principal_offsets: Annotated[np.ndarray | None, "float64 q 2"] = None


@dataclass(frozen=True)
class DepthMaps(CheckedArrays):
    """Stage 3: one depth map per keyframe of `PosedFrames`, in the units of its poses."""

    camera: Camera  # of the keyframes, at depth resolution
    depth: Annotated[np.ndarray, "float32 n h w"]  # z-depth, 0 = unknown
    confidence: Annotated[np.ndarray, "uint8 n h w"]  # 0 unknown, 1 completed by a plane, 2 measured
    affinity: Annotated[np.ndarray | None, "uint8 n 6 h2 w2"] = None  # see `depth.mending.pack_affinities`


@dataclass(frozen=True)
class ScaleEstimate:
    """Source and accuracy of the metric scale."""

    # "marker" | "user-camera-height" | "user-distance" | "user-object" | "user-factor" | "imported-poses" |
    # "metric-depth" | "usual-sizes" | "camera-height-prior" | "table-height-prior" | "subject-distance-prior" |
    # "unknown"
    method: str
    uncertainty: float  # relative standard deviation of the scale
    detail: str  # one sentence for users


@dataclass(frozen=True)
class Plane(CheckedArrays):
    """A bounded plane n . x + d = 0; n is unit and points towards free space. In world space, unless said otherwise."""

    plane: Annotated[np.ndarray, "float64 4"]  # nx, ny, nz, d in metres
    polygon: Annotated[np.ndarray, "float64 k 3"]  # outline, metres, k >= 3

    def moved(self, b_from_a: np.ndarray) -> "Plane":
        """Return the plane in space b, for a similarity (4, 4) and this plane in space a."""
        scale, rotation, shift = split_similarity(b_from_a)
        normal = rotation @ self.plane[:3]
        polygon = transform_points(b_from_a, self.polygon)
        return Plane(np.append(normal, scale * self.plane[3] - normal @ shift), polygon)


@dataclass(frozen=True)
class WorldFrame(CheckedArrays):
    """Stage 4: the similarity transform from `sfm` to `world`, and how it was estimated."""

    world_from_sfm: Annotated[np.ndarray, "float64 4 4"]  # scale in the 3x3 block
    scale: ScaleEstimate
    gravity_method: str  # e.g. "planes+cameras" | "cameras"
    gravity_sigma_deg: float  # standard deviation of the up direction
    floor_observed: bool  # False: the floor is assumed below all seen surface
    yaw_snapped: bool  # walls (or furniture faces) are parallel to x and y
    mirrors: tuple[Plane, ...] = ()  # glass of mirrors, rectangles, in `sfm` space

    def apply_to(self, posed: PosedFrames) -> PosedFrames:
        """Return the frames with cameras and points in world space, in metres."""
        m = self.world_from_sfm
        _, rotation, _ = split_similarity(m)

        def move(poses: np.ndarray) -> np.ndarray:
            out = poses.copy()
            out[:, :3, :3] = rotation @ poses[:, :3, :3]
            out[:, :3, 3] = poses[:, :3, 3] @ m[:3, :3].T + m[:3, 3]
            return out

        return replace(
            posed,
            world_from_camera=move(posed.world_from_camera),
            held_out_world_from_camera=move(posed.held_out_world_from_camera),
            points=posed.points @ m[:3, :3].T + m[:3, 3],
        )

    def depth_in_world(self, depth: DepthMaps, posed: PosedFrames) -> DepthMaps:
        """Return the depth maps in metres, with mirrors at their glass; `posed`: their frames in world space."""
        scaled = replace(depth, depth=depth.depth * np.float32(split_similarity(self.world_from_sfm)[0]))
        return without_reflections(scaled, posed.world_from_camera, self.mirrors_in_world())

    def mirrors_in_world(self) -> tuple[Plane, ...]:
        """Return the glass of the mirrors in world space, metres."""
        return tuple(glass.moved(self.world_from_sfm) for glass in self.mirrors)


@dataclass(frozen=True)
class SpaceGrid(CheckedArrays):
    """Occupancy of a regular voxel grid, axis-aligned in world space."""

    origin: Annotated[np.ndarray, "float64 3"]  # corner of voxel (0, 0, 0), metres
    voxel_size_m: float
    state: Annotated[np.ndarray, "uint8 nx ny nz"]  # 0 unknown, 1 free (a ray passed through), 2 surface

    def lookup(self, points: np.ndarray) -> np.ndarray:
        """Return the state, uint8 (n,), at world points (n, 3); 0 outside of the grid."""
        cell = np.floor((np.asarray(points) - self.origin) / self.voxel_size_m).astype(np.int64)
        inside = np.all((cell >= 0) & (cell < self.state.shape), axis=1)
        out = np.zeros(len(cell), np.uint8)
        i, j, k = cell[inside].T
        out[inside] = self.state[i, j, k]
        return out


@dataclass(frozen=True)
class SurfacePlane(CheckedArrays):
    """A partly seen plane of the room: floor, wall, ceiling, or a support plane (level, can carry things)."""

    label: str  # "floor" | "wall" | "ceiling" | "support"
    surface: Plane  # outline of the seen part: convex, except that of a support, which may be concave
    area_m2: float  # seen surface on the plane
    band_m: float  # largest distance to the plane of surface that belongs to it
    vertices: Annotated[np.ndarray, "int32 k"]  # rows of `Surface.vertices`, ascending; on one plane each


@dataclass(frozen=True)
class Surface(CheckedArrays):
    """Stage 5: the fused visible surface as one triangle mesh in world space, and the occupancy grid."""

    vertices: Annotated[np.ndarray, "float32 v 3"]  # metres
    faces: Annotated[np.ndarray, "int32 f 3"]  # rows of `vertices`, counter-clockwise seen from free space
    normals: Annotated[np.ndarray, "float32 v 3"]  # unit, towards free space
    colors: Annotated[np.ndarray, "uint8 v 3"]  # RGB
    weights: Annotated[np.ndarray, "float32 v"]  # number of views that support the vertex
    voxel_size_m: float  # of the fusion
    space: SpaceGrid
    planes: tuple[SurfacePlane, ...] = ()  # floor, walls, ceiling, then supports by ascending height


@dataclass(frozen=True)
class BaseEntity:
    """A floor, wall or ceiling: static, never an object."""

    id: int
    label: str  # "floor" | "wall" | "ceiling"
    surface: Plane
    observed: bool


@dataclass(frozen=True)
class Instance(CheckedArrays):
    """One object, as segmented from the seen surface."""

    id: int
    label: str  # coarse class: "table", "shelf", "box", … "unknown"
    label_confidence: float
    center: Annotated[np.ndarray, "float64 3"]  # of its upright box, world space, metres
    yaw_rad: float  # of its upright box, about +z
    extents_m: Annotated[np.ndarray, "float64 3"]  # of its upright box
    support_hint: int  # id of what it probably rests on or hangs from, 0 = not known
    attached_hint: bool  # True: hangs on a wall; False: stands


@dataclass(frozen=True)
class InstanceSet(CheckedArrays):
    """Stage 6: instance segmentation of the surface and of the keyframes."""

    vertex_instance: Annotated[np.ndarray, "int32 v"]  # id per vertex of `Surface`, also base; 0 = none
    base: tuple[BaseEntity, ...]
    objects: tuple[Instance, ...]
    id_maps: Annotated[np.ndarray, "uint16 n h w"]  # id seen at each pixel, per keyframe at depth resolution
    structure: int = (
        0  # id of the structure: static surface of no object and no base entity; 0 = there is none
    )

    @property
    def static_ids(self) -> tuple[int, ...]:
        """Return the ids of what is no object: base entities, and the structure."""
        return (*(b.id for b in self.base), *([self.structure] if self.structure else []))

    @property
    def last_id(self) -> int:
        """Return the largest id in use, 0 without any."""
        return max([0, *self.static_ids, *(o.id for o in self.objects)])


@dataclass(frozen=True)
class TexturedMesh(CheckedArrays):
    """A textured triangle mesh; vertices are duplicated at texture seams."""

    vertices: Annotated[np.ndarray, "float32 v 3"]  # metres, +z up, in the space that its owner names
    faces: Annotated[np.ndarray, "int32 f 3"]  # rows of `vertices`
    uvs: Annotated[np.ndarray, "float32 v 2"]  # in [0, 1], origin at the lower left
    texture: Annotated[np.ndarray, "uint8 h w 3"]  # sRGB, row 0 at v = 1


@dataclass(frozen=True)
class ConvexPart(CheckedArrays):
    """One convex part of a collision shape, in object space."""

    vertices: Annotated[np.ndarray, "float32 v 3"]  # metres
    faces: Annotated[np.ndarray, "int32 f 3"]  # rows of `vertices`


@dataclass(frozen=True)
class PhysicalRanges:
    """Ranges (low, high) for domain randomization; each holds the nominal value of `PhysicalAttributes`."""

    mass_kg: tuple[float, float]
    friction: tuple[float, float]
    restitution: tuple[float, float]


@dataclass(frozen=True)
class PhysicalAttributes(CheckedArrays):
    """Physical properties of an object; `AssetProvenance.physics` says where they come from."""

    material: str
    density_kg_m3: float  # of the solid material, before hollowness
    mass_kg: float
    center_of_mass: Annotated[np.ndarray, "float64 3"]  # object space, metres
    inertia: Annotated[np.ndarray, "float64 3 3"]  # about the centre of mass, object axes, kg m^2
    friction: float
    restitution: float
    ranges: PhysicalRanges


@dataclass(frozen=True)
class AssetProvenance:
    """Sources of the parts of an asset."""

    geometry: str  # "observed+completed", or the backend's name
    appearance: str
    physics: str
    observed_fraction: float  # share of the final surface area that at least one frame saw


@dataclass(frozen=True)
class ObjectAsset(CheckedArrays):
    """Stage 7: one complete object. Object space: metres, +z up, origin at the bottom centre of its box."""

    id: int
    label: str
    label_confidence: float
    world_from_object: Annotated[np.ndarray, "float64 4 4"]  # rigid, as reconstructed, before assembly
    visual: TexturedMesh  # closed surface, object space
    collision: tuple[ConvexPart, ...]
    physics: PhysicalAttributes
    provenance: AssetProvenance
    views: Annotated[np.ndarray, "int32 k"]  # video frame numbers that textured it, best first
    support_hint: int  # as in `Instance`
    attached_hint: bool  # as in `Instance`


@dataclass(frozen=True)
class BaseAsset(CheckedArrays):
    """Stage 7: a floor, wall or ceiling with its textured mesh in world space."""

    id: int
    label: str  # "floor" | "wall" | "ceiling"
    plane: Annotated[np.ndarray, "float64 4"]  # n . x + d = 0 in metres, n unit and into the room
    visual: TexturedMesh
    observed: bool
    observed_fraction: float = (
        1.0  # of its texels that a keyframe shows; the rest of the rectangle is completed
    )


@dataclass(frozen=True)
class StructureAsset(CheckedArrays):
    """Stage 7: the structure, measured surface of no object and no base entity, as one static body."""

    id: int
    visual: TexturedMesh  # the open surface as seen, world space
    collision: tuple[ConvexPart, ...]  # thin plates behind the surface, world space
    observed_fraction: float  # of its texels that a keyframe shows


@dataclass(frozen=True)
class Backdrop:
    """Stage 7: a shell around the scene that shows what was filmed beyond its meshes; drawn, never in contact."""

    visual: TexturedMesh  # in world space, faces inward
    observed_fraction: float  # of its texels that a keyframe shows


@dataclass(frozen=True)
class AssetSet:
    """Stage 7: all assets of the scene."""

    base: tuple[BaseAsset, ...]
    objects: tuple[ObjectAsset, ...]
    backdrop: Backdrop | None = None  # None: the scene has no mesh, or was not made from a video
    structure: StructureAsset | None = None  # None: all surface is of objects and base entities

    @property
    def static_labels(self) -> dict[int, str]:
        """Return the labels of what is no object, by id: base entities, and the structure."""
        structure = {} if self.structure is None else {self.structure.id: STRUCTURE}
        return {b.id: b.label for b in self.base} | structure


@dataclass(frozen=True)
class Edge:
    """Edge (child, relation, parent) of the scene graph; child and parent are instance ids."""

    child: int
    relation: str  # "supported_by" | "attached_to"
    parent: int
    confidence: float
    evidence: str


@dataclass(frozen=True)
class SceneGraph:
    """Stage 8: a forest rooted in the base: each object has exactly one parent, without cycles."""

    edges: tuple[Edge, ...]


@dataclass(frozen=True)
class PlacedObject(CheckedArrays):
    """Stage 9: the final pose of an object and how it was reached."""

    id: int
    world_from_object: Annotated[np.ndarray, "float64 4 4"]  # rigid
    dynamic: bool
    moved_m: float  # distance from the reconstructed pose
    turned_deg: float  # rotation from the reconstructed pose
    repair: str  # what made it stand, "" = nothing was needed
    stable: bool
    collision: tuple[ConvexPart, ...] | None = None  # object space; replaces the asset's own after a repair


@dataclass(frozen=True)
class AssembledScene:
    """Stage 9: the scene at rest, with the physics report of CONTRACT section 4."""

    placed: tuple[PlacedObject, ...]
    graph: SceneGraph  # differs from stage 8 where a repair changed a parent
    physics_report: dict = field(default_factory=dict)  # JSON values only
    structure: tuple[
        ConvexPart, ...
    ] = ()  # its collision shape, cut clear of the objects beside it; world space
