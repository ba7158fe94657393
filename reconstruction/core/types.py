"""What crosses stages: frozen dataclasses of NumPy arrays and plain values, in the order of the data flow.

Conventions (docs/conventions.md): transforms are `b_from_a` 4x4 float64; cameras are OpenCV (+x right, +y down,
+z forward); `sfm` space has arbitrary scale and orientation; `world` is metres, +z up, floor at z = 0. Images are
uint8 RGB (h, w, 3). Depth is z-depth, float32, 0 = unknown. Pixel centres lie at (0.5, 0.5). Instance ids are
integers >= 1 that mean the same thing everywhere; 0 = none. Quaternions are wxyz.
All of them are saved and loaded by `reconstruction.core.artifacts`.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from registry.geometry import split_similarity


@dataclass(frozen=True)
class VideoSource:
    """Where the frames came from."""

    file: str
    sha256: str
    width: int
    height: int
    fps: float
    frame_count: int
    duration_s: float


@dataclass(frozen=True)
class FrameSet:
    """Stage 1: chosen frames, upright, at working resolution."""

    source: VideoSource
    images: np.ndarray  # uint8 (n, h, w, 3) keyframes, in time order; none of them held out
    indices: np.ndarray  # int32 (n,) decoded video frame number of each
    times_s: np.ndarray  # float64 (n,)
    sharpness: np.ndarray  # float32 (n,) larger is sharper, comparable within one video only
    held_out_images: (
        np.ndarray
    )  # uint8 (m, h, w, 3) every tenth video frame (index % 10 == 0), for evaluation only
    held_out_indices: np.ndarray  # int32 (m,)
    held_out_times_s: np.ndarray  # float64 (m,)
    focal_prior_px: float  # from metadata, 0 where unknown
    ordered: (
        bool  # True for a video, False for a folder of images (neighbours in name order may be far apart)
    )


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion; pixel centres at (0.5, 0.5)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def matrix(self) -> np.ndarray:
        """Return the 3x3 intrinsic matrix K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def resized(self, width: int, height: int) -> "Camera":
        """Return the camera of the same view sampled at another resolution."""
        sx, sy = width / self.width, height / self.height
        return Camera(width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy)

    @property
    def intrinsics(self) -> np.ndarray:
        """Return fx, fy, cx, cy as float64 (4,), as compiled kernels take them."""
        return np.array([self.fx, self.fy, self.cx, self.cy], np.float64)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project points (..., 3) of the camera's frame; return columns and rows (...), in pixels.

        Points need z > 0; others project to what the formula gives, without a check.
        """
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        return self.fx * x / z + self.cx, self.fy * y / z + self.cy

    def unproject(self, columns: np.ndarray, rows: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return the points (..., 3) of the camera's frame at pixels, in the units of `z`.

        Args:
            columns: pixel coordinates, the centre of the first pixel is 0.5.
            rows: the same.
            z: depth along the optical axis, 1 for rays.
        """
        x, y = (columns - self.cx) / self.fx * z, (rows - self.cy) / self.fy * z
        return np.stack(np.broadcast_arrays(x, y, z), axis=-1)

    def pixel_rays(self) -> np.ndarray:
        """Return the rays float64 (height, width, 3) through the centres of all pixels, z = 1."""
        columns, rows = np.arange(self.width) + 0.5, np.arange(self.height) + 0.5
        return self.unproject(columns[None, :], rows[:, None], np.ones((self.height, self.width)))


@dataclass(frozen=True)
class PosedFrames:
    """Stage 2: undistorted keyframes with cameras, in `sfm` space (in `world` after `WorldFrame.apply_to`)."""

    source: VideoSource
    camera: Camera  # shared by all frames, at the resolution of `images`
    images: np.ndarray  # uint8 (n, h, w, 3), undistorted
    indices: np.ndarray  # int32 (n,)
    times_s: np.ndarray  # float64 (n,)
    world_from_camera: np.ndarray  # float64 (n, 4, 4)
    sharpness: np.ndarray  # float32 (n,)
    held_out_images: np.ndarray  # uint8 (m, h, w, 3), undistorted; only those that could be registered
    held_out_indices: np.ndarray  # int32 (m,)
    held_out_times_s: np.ndarray  # float64 (m,)
    held_out_world_from_camera: np.ndarray  # float64 (m, 4, 4)
    points: np.ndarray  # float64 (p, 3) sparse points
    point_colors: np.ndarray  # uint8 (p, 3)
    point_errors_px: np.ndarray  # float32 (p,) mean reprojection error
    observations: np.ndarray  # int32 (o, 2) pairs (frame row, point row): which frame saw which point
    chosen_frames: (
        int  # how many keyframes were given, so that len(images) / chosen_frames is the registered share
    )
    ordered: bool  # frames follow each other in time
    reprojection_error_px: float
    metric: bool = False  # poses were imported from a tracker that measures metres (ARKit)


@dataclass(frozen=True)
class DepthMaps:
    """Stage 3: one depth map per posed keyframe, in the units of its poses."""

    camera: Camera  # the frames' camera at depth resolution
    depth: np.ndarray  # float32 (n, h, w) z-depth, 0 = unknown
    confidence: (
        np.ndarray
    )  # uint8 (n, h, w): 0 unknown, 1 completed (a plane that its surroundings support), 2 measured
    affinity: np.ndarray | None = (
        None  # uint8 (n, 6, ceil(h / 2), ceil(w / 2)), see `depth.mending.pack_affinities`
    )


@dataclass(frozen=True)
class ScaleEstimate:
    """How metres were found."""

    # "marker" | "user-camera-height" | "user-distance" | "user-object" | "user-factor" | "imported-poses" |
    # "metric-depth" | "camera-height-prior" | "table-height-prior" | "subject-distance-prior" | "unknown"
    method: str
    uncertainty: float  # relative 1-sigma of the scale
    detail: str  # one sentence for people


@dataclass(frozen=True)
class WorldFrame:
    """Stage 4: the similarity that takes `sfm` to `world`, and how it was found."""

    world_from_sfm: np.ndarray  # float64 (4, 4), scale inside the 3x3 block
    scale: ScaleEstimate
    gravity_method: str  # e.g. "planes+cameras" | "cameras"
    gravity_sigma_deg: float
    floor_observed: bool  # False: the floor is assumed below everything seen
    yaw_snapped: bool  # walls (or furniture edges) are parallel to x and y

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

    def scale_depth(self, depth: DepthMaps) -> DepthMaps:
        """Return the depth maps in metres."""
        return replace(depth, depth=depth.depth * np.float32(split_similarity(self.world_from_sfm)[0]))


@dataclass(frozen=True)
class SpaceGrid:
    """What is known of space, on a coarse regular grid in world space; later stages carve with it."""

    origin: np.ndarray  # float64 (3,) corner of voxel (0, 0, 0)
    voxel_size_m: float
    state: np.ndarray  # uint8 (nx, ny, nz): 0 unknown, 1 free (a ray passed through), 2 surface

    def lookup(self, points: np.ndarray) -> np.ndarray:
        """Return the state (n,) at world points (n, 3); outside the grid is unknown."""
        cell = np.floor((np.asarray(points) - self.origin) / self.voxel_size_m).astype(np.int64)
        inside = np.all((cell >= 0) & (cell < self.state.shape), axis=1)
        out = np.zeros(len(cell), np.uint8)
        i, j, k = cell[inside].T
        out[inside] = self.state[i, j, k]
        return out


@dataclass(frozen=True)
class Plane:
    """A bounded plane: n . x + d = 0, n towards free space."""

    plane: np.ndarray  # float64 (4,) nx, ny, nz, d
    polygon: np.ndarray  # float64 (k, 3) outline in world space, k >= 3


@dataclass(frozen=True)
class SurfacePlane:
    """A plane of the room of which some was seen: what bounds it, or something level that can carry things."""

    label: str  # "floor" | "wall" | "ceiling" | "support"
    surface: Plane  # outline of what was seen: a convex one, of a support one that follows its bays
    area_m2: float  # of the seen surface on it
    band_m: float  # surface within this distance belongs to it
    vertices: np.ndarray  # int32 (k,) vertices of the surface on it, ascending; no vertex is on two planes


@dataclass(frozen=True)
class Surface:
    """Stage 5: the fused visible surface in world space, as one triangle mesh, and the state of space."""

    vertices: np.ndarray  # float32 (v, 3) metres
    faces: np.ndarray  # int32 (f, 3), counter-clockwise seen from free space
    normals: np.ndarray  # float32 (v, 3) unit, towards free space
    colors: np.ndarray  # uint8 (v, 3)
    weights: np.ndarray  # float32 (v,) how many views support the vertex
    voxel_size_m: float
    space: SpaceGrid
    planes: tuple[SurfacePlane, ...] = ()  # floor, walls, ceiling, then supports from the lowest up


@dataclass(frozen=True)
class BaseEntity:
    """Floor, wall or ceiling: static and never an object."""

    id: int
    label: str  # "floor" | "wall" | "ceiling"
    surface: Plane
    observed: bool


@dataclass(frozen=True)
class Instance:
    """One separate thing, as seen."""

    id: int
    label: str  # coarse: "table", "shelf", "box", … "unknown"
    label_confidence: float
    center: np.ndarray  # float64 (3,) of its box in world space
    yaw_rad: float  # of its upright box
    extents_m: np.ndarray  # float64 (3,) of its box
    support_hint: int  # id of the thing that it seems to rest on or hang from (0: not known)
    attached_hint: bool  # hangs on a wall rather than stands


@dataclass(frozen=True)
class InstanceSet:
    """Stage 6: the surface cut into things."""

    vertex_instance: np.ndarray  # int32 (v,) per surface vertex; base entities have ids too; 0 = none
    base: tuple[BaseEntity, ...]
    objects: tuple[Instance, ...]
    id_maps: np.ndarray  # uint16 (n, h, w) per keyframe at depth resolution: which id is seen at each pixel


@dataclass(frozen=True)
class TexturedMesh:
    """A textured triangle mesh; vertices are duplicated at texture seams."""

    vertices: np.ndarray  # float32 (v, 3) in its own space, +z up, metres
    faces: np.ndarray  # int32 (f, 3)
    uvs: np.ndarray  # float32 (v, 2), origin at the lower left (glTF readers flip as they need)
    texture: np.ndarray  # uint8 (t, t, 3) sRGB, row 0 at v = 1


@dataclass(frozen=True)
class ConvexPart:
    """One convex piece of a collision shape, in object space."""

    vertices: np.ndarray  # float32 (v, 3)
    faces: np.ndarray  # int32 (f, 3)


@dataclass(frozen=True)
class PhysicalRanges:
    """Between what values a simulation may draw: (low, high), the value itself within."""

    mass_kg: tuple[float, float]
    friction: tuple[float, float]
    restitution: tuple[float, float]


@dataclass(frozen=True)
class PhysicalAttributes:
    """What the simulator needs besides shape; provenance is `AssetProvenance.physics`."""

    material: str
    density_kg_m3: float  # of the solid matter, before hollowness
    mass_kg: float
    center_of_mass: np.ndarray  # float64 (3,) object space
    inertia: np.ndarray  # float64 (3, 3) about the centre of mass, object axes, kg m^2
    friction: float
    restitution: float
    ranges: PhysicalRanges


@dataclass(frozen=True)
class AssetProvenance:
    """Where each part of an asset came from."""

    geometry: str  # "observed+completed", or the backend's name
    appearance: str
    physics: str
    observed_fraction: float  # share of the final surface area that some frame saw


@dataclass(frozen=True)
class ObjectAsset:
    """Stage 7: one complete object. Object space: origin at the bottom centre of its box, +z up, metres."""

    id: int
    label: str
    label_confidence: float
    world_from_object: np.ndarray  # float64 (4, 4) rigid, as reconstructed (before assembly)
    visual: TexturedMesh  # closed surface
    collision: tuple[ConvexPart, ...]
    physics: PhysicalAttributes
    provenance: AssetProvenance
    views: np.ndarray  # int32 (k,) video frame numbers that textured it, best first
    support_hint: int
    attached_hint: bool


@dataclass(frozen=True)
class BaseAsset:
    """Stage 7: a floor, wall or ceiling with its looks. The mesh is in world space."""

    id: int
    label: str
    plane: np.ndarray  # float64 (4,) n . x + d = 0, n into the room
    visual: TexturedMesh
    observed: bool


@dataclass(frozen=True)
class AssetSet:
    """Stage 7: everything that the scene is built from."""

    base: tuple[BaseAsset, ...]
    objects: tuple[ObjectAsset, ...]


@dataclass(frozen=True)
class Edge:
    """(child, relation, parent) of the scene graph."""

    child: int
    relation: str  # "supported_by" | "attached_to"
    parent: int
    confidence: float
    evidence: str


@dataclass(frozen=True)
class SceneGraph:
    """Stage 8: every object has exactly one parent; rooted in the base; no cycle."""

    edges: tuple[Edge, ...]


@dataclass(frozen=True)
class PlacedObject:
    """Stage 9: where an object ended, and how."""

    id: int
    world_from_object: np.ndarray  # float64 (4, 4)
    dynamic: bool
    moved_m: float  # from the reconstructed pose
    turned_deg: float
    repair: str  # "" or what was done to make it stand
    stable: bool
    collision: tuple[ConvexPart, ...] | None = None  # object space; what a repair made of the asset's own


@dataclass(frozen=True)
class AssembledScene:
    """Stage 9: the scene at rest, with the physics report card of CONTRACT section 4."""

    placed: tuple[PlacedObject, ...]
    graph: SceneGraph  # may differ from stage 8 where a repair chose another parent
    physics_report: dict = field(default_factory=dict)  # JSON values only
