"""Crops of keyframes around proposals, the choice of distinct proposals, and the networks that score crops."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from fused_surfaces import box, fused
from scipy.sparse import csr_matrix
from surfaces import frames_of, with_planes

from reconstruction.core.progress import NO_PROGRESS
from reconstruction.core.trunk import load_trunk
from reconstruction.instances.cut import Shell
from reconstruction.instances.partition.crop_scores import CropScorer, color_input, head_inputs, mirrored
from reconstruction.instances.partition.crops import GRID, MAPS, SIZE_PX, VIEWS, crops_of
from reconstruction.instances.partition.features import View
from reconstruction.instances.partition.model import load_models
from reconstruction.instances.partition.proposals import distinct
from reconstruction.instances.sightings import sightings
from registry.errors import EnvironmentMissing

RED, BLUE = (190, 40, 40), (40, 60, 170)


@pytest.fixture(scope="module")
def seen():
    """A view of a red and a blue box on a floor, the cluster of each vertex (2 = none), and three proposals."""
    surface = with_planes(
        fused([box((-0.4, -0.1, 0.3), (-0.2, 0.1, 0.4), RED), box((0.1, -0.1, 0.3), (0.4, 0.1, 0.4), BLUE)])
    )
    posed, depth = frames_of(surface)
    shell = Shell.of(surface, NO_PROGRESS)
    view = View.of(shell.graph, surface, sightings(surface, posed, depth))
    x, z = view.mesh.points[:, 0], view.mesh.points[:, 2]
    region = np.where(z < 0.25, 2, np.where(x < 0, 0, 1))
    return view, region, csr_matrix(np.array([[1.0, 0], [0, 1], [1, 1]]))


def test_a_crop_shows_the_proposal_in_its_middle_and_its_color_there(seen):
    view, region, members = seen
    crops = crops_of(view, region, members, np.arange(3))
    assert crops.color.shape[1:] == (SIZE_PX, SIZE_PX, 3)
    assert crops.maps.shape[1:] == (len(MAPS), GRID, GRID)
    assert set(crops.proposal) == {0, 1, 2}
    assert np.bincount(crops.proposal).max() <= VIEWS
    for number, color in ((0, RED), (1, BLUE)):
        for k in np.flatnonzero(crops.proposal == number):
            inside = crops.maps[k, MAPS.index("inside")] > 100
            row, column = np.nonzero(inside)
            assert abs((row.min() + row.max()) / 2 - (GRID - 1) / 2) < 2
            assert abs((column.min() + column.max()) / 2 - (GRID - 1) / 2) < 2
            shown = crops.color[k].reshape(GRID, 4, GRID, 4, 3).mean(axis=(1, 3))[inside].mean(axis=0)
            away = [np.linalg.norm(shown - c) for c in (color, RED if color is BLUE else BLUE)]
            assert away[0] < 0.5 * away[1]
            assert not (crops.maps[k, MAPS.index("other_thing")][inside] > 0).any()


def test_a_part_sees_the_other_part_beside_it(seen):
    view, region, _ = seen
    halves = np.where((region == 1) & (view.mesh.points[:, 0] > 0.25), 2, region)
    halves = np.where(region == 2, 3, halves)
    crops = crops_of(view, halves, csr_matrix(np.eye(3)), np.array([1, 2]))
    assert (crops.maps[:, MAPS.index("other_thing")] > 0).any(axis=(1, 2)).all()


def test_what_no_keyframe_shows_has_no_crop(seen):
    view, region, members = seen
    hidden = np.where(region == 0, 2, region)
    crops = crops_of(view, hidden, members, np.array([0, 1]))
    assert set(crops.proposal) == {1}
    nothing = crops_of(view, hidden, members, np.array([0]))
    assert len(nothing.proposal) == len(nothing.color) == len(nothing.maps) == len(nothing.scalars) == 0


def test_distinct_proposals_are_the_best_of_those_alike():
    rng = np.random.default_rng(0)
    members = csr_matrix((rng.random((300, 12)) < 0.5).astype(float))
    members = members[np.diff(members.indptr) > 0]
    area, score = rng.uniform(0.1, 1, 12), rng.normal(size=members.shape[0])
    standing = distinct(members, area, score, 10_000, 0.7)
    kept = np.unique(standing)
    dense = members.toarray() > 0
    shared = (dense * area) @ dense.T
    own = dense @ area
    iou = shared / (own[:, None] + own - shared)
    among = iou[np.ix_(kept, kept)] - np.eye(len(kept))
    assert among.max() <= 0.7
    np.testing.assert_array_equal(standing[kept], kept)
    assert (score[standing] >= score).all()
    assert (iou[np.arange(len(score)), standing] > 0.7).all()
    few = distinct(members, area, score, 5, 0.7)
    best = kept[np.argsort(-score[kept])[:5]]
    np.testing.assert_array_equal(np.unique(few[few >= 0]), np.sort(best))
    np.testing.assert_array_equal(few >= 0, (iou[:, best] > 0.7).any(axis=1))
    assert len(distinct(members[:0], area, score[:0], 5, 0.7)) == 0


def test_scores_come_from_the_picture_and_are_the_same_each_time(seen):
    view, region, members = seen
    scorer, logit = load_models().crops, np.zeros(3)
    rows, said = scorer(view, region, members, logit)
    np.testing.assert_array_equal(rows, [0, 1, 2])
    assert np.isfinite(said).all()
    np.testing.assert_array_equal(scorer(view, region, members, logit)[1], said)
    gray = replace(view, frames=[replace(f, picture=np.full_like(f.picture, 127)) for f in view.frames])
    assert np.abs(scorer(gray, region, members, logit)[1] - said).max() > 0.01
    rows, said = scorer(view, region, members[:0], logit[:0])
    assert len(rows) == len(said) == 0


def test_the_mirror_image_of_a_mirror_image_is_the_input(seen):
    view, region, members = seen
    crops = crops_of(view, region, members, np.arange(3))
    heads = load_models().crops.heads
    with torch.inference_mode():
        inputs = (*load_trunk()(color_input(crops.color))[2:], *head_inputs(crops.maps, crops.scalars))
        again = mirrored(*mirrored(*inputs))
        assert all(torch.equal(a, b) for a, b in zip(inputs, again))
        assert not torch.equal(heads[0](*inputs), heads[0](*mirrored(*inputs)))


def test_weights_that_do_not_fit_say_what_to_do():
    weights = dict(load_models().crops.weights)
    with pytest.raises(KeyError, match="trunk"):
        CropScorer({**weights, "trunk.stem.bias": np.zeros(32)}).check()
    with pytest.raises(KeyError, match="nothing"):
        CropScorer({}).check()
    weights.pop("heads.0.scalars.bias")
    with pytest.raises(EnvironmentMissing, match="Install the package again"):
        _ = CropScorer(weights).heads
