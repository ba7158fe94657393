"""The columns of the tables: which figure, how it is shown, what it means."""

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Column:
    """One figure."""

    key: str  # its name in the evaluation (CONTRACT section 4) or in the result
    title: str
    digits: int
    better: str  # "↑", "↓" or ""
    factor: float = 1.0

    @property
    def head(self) -> str:
        """The column's heading."""
        return f"{self.title}{self.better}"

    def shown(self, value: float) -> str:
        """Format a value."""
        return f"{value * self.factor:.{self.digits}f}"


RECALL_25 = Column("object_recall_25", "recall@.25 ", 2, "↑")
PRECISION_25 = Column("object_precision_25", "prec@.25 ", 2, "↑")
RECALL_50 = Column("object_recall_50", "recall@.5 ", 2, "↑")
PRECISION_50 = Column("object_precision_50", "prec@.5 ", 2, "↑")
CD = Column("cd_cm", "cd cm ", 2, "↓")
F_5CM = Column("f_5cm", "f 5cm % ", 1, "↑")
NC = Column("nc", "nc % ", 1, "↑")
OBJECT_CD = Column("object_cd_cm", "object cd cm ", 2, "↓")
OBJECT_F = Column("object_f_1cm", "object f 1cm % ", 1, "↑")
GRAPH_F1 = Column("graph_f1", "graph f1 ", 2, "↑")
PSNR = Column("psnr_db", "psnr dB ", 2, "↑")
SSIM = Column("ssim", "ssim ", 3, "↑")
LPIPS = Column("lpips", "lpips ", 3, "↓")
COVERAGE = Column("coverage", "coverage ", 2, "↑")
HOLES = Column("holes", "holes ", 4, "↓")
STABLE = Column("stable_rate", "stable ", 2, "↑")
STABLE_10CM = Column("stable_rate_10cm_0.1rad", "stable 10cm/0.1rad ", 2, "↑")
STABLE_DROP = Column("stable_rate_5cm_drop_5deg", "stable 5cm/5° ", 2, "↑")
PENETRATION = Column("spawn_penetration_mm", "penetration mm ", 2, "↓")
FLOATING = Column("floating_rate", "floating ", 2, "↓")
ATE = Column("ate_cm", "ate cm ", 2, "↓")
SCALE = Column("scale_error", "scale error ", 3, "↓")
TIME = Column("time_s", "time s ", 0, "↓")
MEMORY = Column("peak_memory_mb", "memory MB ", 0, "↓")
OBJECTS = Column("objects", "objects ", 0, "")
REGISTERED = Column("registered_share", "frames registered ", 2, "↑")

# Deleting what is hard must not pay: recall and precision stand in every table.
FOUND = (RECALL_25, PRECISION_25)
GEOMETRY = (*FOUND, RECALL_50, PRECISION_50, CD, F_5CM, NC, OBJECT_CD, OBJECT_F, GRAPH_F1)
LOOKS_AND_COST = (*FOUND, PSNR, SSIM, COVERAGE, HOLES, ATE, SCALE, TIME, MEMORY)
PHYSICS = (*FOUND, STABLE, STABLE_10CM, STABLE_DROP, PENETRATION, FLOATING)
# Figures of single stages, so that a bad end result can be traced to where it began.
STAGES = (
    *FOUND,
    Column("stages.poses.registered_share", "frames registered ", 2, "↑"),
    Column("stages.depth.known_share", "depth known % ", 1, "↑", 100.0),
    Column("stages.depth.median_rel", "depth error % ", 2, "↓", 100.0),
    Column("stages.depth.share_over_5_percent", "depth off > 5 % ", 1, "↓", 100.0),
    Column("stages.gaussians.psnr_db", "Gaussians psnr dB ", 2, "↑"),
    Column("stages.gaussians.depth_maps.share_over_5_percent", "their depth off > 5 % ", 1, "↓", 100.0),
    Column("stages.surface.cd_cm", "surface cd cm ", 2, "↓"),
    Column("stages.surface.f_5cm", "surface f 5cm % ", 1, "↑"),
    Column("stages.surface.nc", "surface nc % ", 1, "↑"),
    Column("stages.instances.surface.mean_iou", "instances IoU ", 2, "↑"),
    Column("stages.instances.per_view.mean_iou", "per view ", 2, "↑"),
    Column("stages.assembly.median_moved_cm", "moved cm ", 2, "↓"),
)
GROUPS = (
    ("Objects and geometry", GEOMETRY),
    ("Rendering, cameras, cost", LOOKS_AND_COST),
    ("Physics", PHYSICS),
    ("Stages", STAGES),
)
# Without entities in the truth: what the run itself can be asked.
REAL = (
    REGISTERED,
    OBJECTS,
    PSNR,
    SSIM,
    COVERAGE,
    HOLES,
    STABLE,
    STABLE_10CM,
    STABLE_DROP,
    PENETRATION,
    FLOATING,
    ATE,
    CD,
    F_5CM,
    TIME,
    MEMORY,
)
# Against outlines that were drawn by hand on a few frames.
OUTLINES = (
    Column("outline_recall_25", "recall@.25 ", 2, "↑"),
    Column("outline_precision_25", "prec@.25 ", 2, "↑"),
    Column("outline_recall_50", "recall@.5 ", 2, "↑"),
    Column("outline_precision_50", "prec@.5 ", 2, "↑"),
    Column("outline_edges", "right parents ", 2, "↑"),
    Column("outline_things", "things asked for ", 0, ""),
    Column("outline_objects", "objects judged ", 0, ""),
    Column("outline_frames", "frames ", 0, ""),
)
# What the truth in place of a stage changes.
ORACLE = (*FOUND, CD, F_5CM, NC, OBJECT_CD, OBJECT_F, GRAPH_F1, PSNR, STABLE)

# Table 1 of the paper, in the units of the evaluation: cm, percent, seconds.
PAPER_ROWS: tuple[tuple[str, dict[str, float]], ...] = tuple(
    (
        name,
        {
            "cd_cm": cd,
            "f_5cm": f,
            "nc": nc,
            "psnr_db": psnr,
            "ssim": ssim,
            "lpips": lpips,
            "time_s": 60.0 * minutes,
        },
    )
    for name, cd, f, nc, psnr, ssim, lpips, minutes in (
        ("Gen3DSR (single view)", 11.69, 30.19, 70.50, 19.26, 0.886, 0.425, 17),
        ("SceneGen (single view)", 7.66, 46.72, 79.13, 18.18, 0.873, 0.334, 6),
        ("DPRecon", 9.26, 46.12, 78.28, 21.97, 0.913, 0.257, 642),
        ("InstaScene", 6.90, 49.69, 82.55, 22.35, 0.907, 0.302, 29),
        ("SimRecon (the paper)", 4.34, 62.65, 87.37, 24.43, 0.924, 0.153, 21),
    )
)
PAPER = (CD, replace(F_5CM, digits=2), replace(NC, digits=2), PSNR, SSIM, LPIPS, TIME)  # as published
