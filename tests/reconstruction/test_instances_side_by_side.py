"""Things that touch side by side are cut at the waist of their outline; what has none stays whole."""

import numpy as np
import pytest
from fused_surfaces import box, can, fused

from reconstruction.instances import InstancesConfig
from reconstruction.instances.segmentation import Thing
from reconstruction.instances.side_by_side import cut_side_by_side
from reconstruction.progress import NO_PROGRESS
from reconstruction.surface.mesh_graph import MeshGraph

GRAY = (150, 150, 155)


def scene(*solids):
    """Return solids on a floor, joined as fusion does, and all that stands above the floor."""
    surface = fused(list(solids), half_m=0.25, top_m=0.3)
    graph = MeshGraph.from_surface(surface)
    return surface, graph, np.flatnonzero(graph.points[:, 2] > 0.012)


@pytest.mark.parametrize("second_top_m", [0.1, 0.12], ids=["of one height", "one higher"])
def test_two_cans_with_a_smear_between_them_are_two(second_top_m):
    surface, graph, above = scene(
        can((-0.048, 0.0), 0.04, 0.0, 0.1, GRAY),
        can((0.048, 0.01), 0.04, 0.0, second_top_m, GRAY),
        box((-0.03, -0.018, 0.0), (0.03, 0.028, 0.09), GRAY),
    )
    whole = Thing(above)
    lid = Thing(
        above[(graph.points[above, 0] > 0.03) & (graph.points[above, 2] > second_top_m - 0.02)], whole
    )
    things = cut_side_by_side(graph, surface, [whole, lid], InstancesConfig(), NO_PROGRESS)
    assert len(things) == 3
    left, right = sorted((things[0], things[2]), key=lambda thing: graph.points[thing.vertices, 0].mean())
    assert lid.rests_on is right
    assert graph.points[left.vertices, 0].max() < 0.02
    assert graph.points[right.vertices, 0].min() > -0.02
    assert len(np.intersect1d(left.vertices, right.vertices)) == 0
    assert len(np.union1d(left.vertices, right.vertices)) == len(above)


@pytest.mark.parametrize(
    "solids",
    [
        [can((0.0, 0.0), 0.045, 0.0, 0.1, GRAY), box((0.04, -0.008, 0.02), (0.08, 0.008, 0.08), GRAY)],
        [box((-0.1, -0.05, 0.0), (0.1, 0.05, 0.08), GRAY)],
        [
            box((-0.1, -0.04, 0.0), (0.1, 0.03, 0.12), GRAY),
            box((-0.1, -0.04, 0.0), (-0.03, 0.12, 0.12), GRAY),
        ],
        [can((0.0, 0.0), 0.04, 0.0, 0.1, GRAY), box((0.0, -0.03, 0.0), (0.12, 0.03, 0.015), GRAY)],
    ],
    ids=["a mug", "a box", "an L", "a can with a skirt"],
)
def test_what_has_no_waist_stays_whole(solids):
    surface, graph, above = scene(*solids)
    assert len(cut_side_by_side(graph, surface, [Thing(above)], InstancesConfig(), NO_PROGRESS)) == 1
