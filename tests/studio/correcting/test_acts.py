"""Acts: entries with anchors that last, checked against what the stages make of them."""

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from rooms.small_room import SCENE

from reconstruction.core.types import DistortedCamera
from reconstruction.editing.addresses import parse_address
from reconstruction.editing.overrides import Overrides
from reconstruction.poses.lens import Lens
from registry import SceneRegistry
from registry.errors import UsageError
from studio.correcting.act_list import words_of
from studio.correcting.acts import Outline
from studio.correcting.anchoring import Anchors
from studio.correcting.session import Session
from studio.correcting.yaml_text import one_line
from studio.selection import Click

pytestmark = pytest.mark.stage


@pytest.fixture(scope="module")
def pristine(reconstructed):
    bundle, stages = reconstructed.open()
    return bundle, stages


@pytest.fixture
def session(reconstructed, tmp_path):
    registry = SceneRegistry(reconstructed.registry)
    made = Session(registry, registry.load(SCENE))
    while made.document.undo().undo is not None:
        pass
    yield made
    made.close()


def click(owner: int, point, **said) -> Click:
    up = np.array([0, 0, 1.0])
    return Click(
        owner, np.asarray(point, float), up, point + up, -up, said.get("frame"), said.get("pixel"), 0
    )


def thing_of(session: Session, label: str) -> int:
    return next(o.id for o in session.bundle.objects if o.label == label or label in o.name)


def test_the_address_of_each_thing_means_that_thing(session):
    pointer = session.previewer.pointer()
    for item in session.bundle.objects:
        assert pointer.thing(parse_address(session.anchors.thing(item.id), "")).id == item.id


def test_a_clicked_point_becomes_a_pixel_that_means_the_same_spot(session):
    pointer = session.previewer.pointer()
    points, owner = np.asarray(pointer.surface.vertices, float), np.asarray(pointer.found.vertex_instance)
    spacing = np.median(
        np.linalg.norm(points[pointer.surface.faces[:, 0]] - points[pointer.surface.faces[:, 1]], axis=1)
    )
    rng, as_pixels = np.random.default_rng(0), 0
    owners = [o.id for o in session.bundle.objects] + [b.id for b in session.bundle.base]
    for number in owners:
        rows = np.flatnonzero(owner == number)
        for row in rng.choice(rows, min(6, len(rows)), replace=False):
            place = session.anchors.place(points[row], number)
            address = parse_address(place, "")
            assert pointer.entity(address).id == number
            if "pixel" in place and number in pointer._things:
                as_pixels += 1
                assert np.linalg.norm(pointer.point(address) - points[row]) < 0.03 + 3 * spacing
    assert as_pixels >= 6


def test_pixels_are_counted_in_the_film_with_its_lens(pristine):
    """The map to filmed pixels is the inverse of the one by which clicks are read."""
    bundle, stages = pristine
    camera = stages.get("poses").camera
    distorted = DistortedCamera(
        "OPENCV", camera.width, camera.height,
        np.array([camera.fx, camera.fy, camera.cx, camera.cy, -0.2, 0.05, 0.001, -0.002]),
    )  # fmt: skip
    from dataclasses import replace

    lens = Lens(camera, distorted)
    anchors = Anchors(bundle, stages)
    with_lens = replace(stages.get("poses"), distorted=distorted)
    anchors._results = type(
        "Results", (), {"get": lambda self, name: with_lens if name == "poses" else None}
    )()
    rng = np.random.default_rng(1)
    inner = rng.uniform(
        [0.2 * camera.width, 0.2 * camera.height], [0.8 * camera.width, 0.8 * camera.height], (30, 2)
    )
    filmed = np.array(anchors.filmed([(x, y) for x, y in inner], 0))
    source = bundle.scene["source"]
    working = filmed * [camera.width / source["width"], camera.height / source["height"]]
    back = lens.straightened(working)
    assert np.abs(back - inner).max() < 0.1
    assert np.abs(working - inner).max() > 1  # the lens matters


def test_the_stages_take_each_act(session):
    """Each act, alone, is an entry that its stage applies as meant."""
    acts, pointer = session.acts, session.previewer.pointer()
    mug, box = thing_of(session, "box"), session.bundle.objects[0].id
    mug = next(o.id for o in session.bundle.objects if o.id != box)

    def cut(act):
        return Overrides([act.entry]).apply_to_instances(pointer)

    assert next(o for o in cut(acts.relabel(mug, "cup")).objects if o.id == mug).label == "cup"
    assert mug not in [o.id for o in cut(acts.drop(mug)).objects]
    assert len(cut(acts.merge([mug, box])).objects) == len(pointer.found.objects) - 1
    base = cut(acts.make_base(mug, "wall"))
    assert mug in [b.id for b in base.base]
    rows = np.flatnonzero(np.asarray(pointer.found.vertex_instance) == box)
    points = np.asarray(pointer.surface.vertices, float)[rows]
    ends = points[np.argmin(points[:, 0])], points[np.argmax(points[:, 0])]
    parts = cut(acts.split([[click(box, ends[0])], [click(box, ends[1])]]))
    assert len(parts.objects) == len(pointer.found.objects) + 1
    _, stages = session.bundle, session.results
    heavy = Overrides([acts.mass(mug, 2.345678).entry]).apply_to_assets(stages.get("assets"), pointer)
    assert next(o for o in heavy.objects if o.id == mug).physics.mass_kg == pytest.approx(2.346)
    pose = np.asarray(next(o for o in stages.get("assets").objects if o.id == mug).world_from_object).copy()
    pose[:2, 3] += 0.25
    moved = Overrides([acts.move(mug, pose).entry]).apply_to_assets(stages.get("assets"), pointer)
    assert np.abs(next(o for o in moved.objects if o.id == mug).world_from_object - pose).max() < 2e-4
    large = Overrides([acts.size(mug, [0.3, 0.2, 0.1]).entry]).apply_to_assets(stages.get("assets"), pointer)
    stretched = next(o for o in large.objects if o.id == mug).visual.vertices
    np.testing.assert_allclose(np.ptp(stretched, axis=0), [0.3, 0.2, 0.1], atol=1e-5)
    floor = next(b for b in session.bundle.base if b.label == "floor")
    rows = np.flatnonzero(np.asarray(pointer.found.vertex_instance) == floor.id)
    spot = np.asarray(pointer.surface.vertices, float)[rows[len(rows) // 2]]
    graph = stages.get("scene_graph").plain()
    below = Overrides([acts.parent(mug, click(floor.id, spot)).entry]).apply_to_graph(
        graph, stages.get("assets"), pointer
    )
    assert next(e for e in below.edges if e.child == mug).parent == floor.id


def test_scale_up_and_floor_come_once(session):
    floor = next(b for b in session.bundle.base if b.label == "floor")
    pointer = session.previewer.pointer()
    rows = np.flatnonzero(np.asarray(pointer.found.vertex_instance) == floor.id)
    spots = np.asarray(pointer.surface.vertices, float)[rows[:: max(1, len(rows) // 40)]]
    seen = [click(floor.id, p) for p in spots if "pixel" in session.anchors.place(p, floor.id)]
    session.perform(session.acts.scale(seen[0], seen[-1], 1.25))
    session.perform(session.acts.floor(seen[0]))
    state = session.perform(session.acts.scale(seen[0], seen[-1], 1.5))
    assert [sorted(entry) for entry in state.entries] == [["scale"], ["floor"]]
    assert state.entries[0]["scale"]["metres"] == 1.5
    assert Overrides.load(session.document.path).scene_entries().scale is not None
    assert session.document.undo().entries[0]["scale"]["metres"] == 1.25


def test_moves_in_a_row_are_one_entry(session):
    number = session.bundle.objects[0].id
    pose = session.bundle.objects[0].world_from_object.copy()
    for _ in range(3):
        pose[0, 3] += 0.1
        state = session.perform(session.acts.move(number, pose))
    assert len(state.entries) == 1
    assert np.allclose(session.preview(state).poses[number], pose, atol=1e-4)
    assert np.allclose(
        session.preview(session.document.undo()).poses[number][0, 3], pose[0, 3] - 0.1, atol=1e-4
    )


def test_the_preview_follows_the_acts(session):
    first, second = (o.id for o in session.bundle.objects[:2])
    session.perform(session.acts.merge([first, second]))
    session.perform(session.acts.relabel(second, "pair"))
    session.perform(session.acts.size(first, [0.3, 0.2, 0.1]))
    state = session.perform(session.acts.drop(first))
    shown = session.previewer.full(state.entries)
    assert shown.merged == [{first, second}]
    assert shown.labels == {first: "pair", second: "pair"}
    assert shown.hidden == {first, second}
    assert shown.error == ""
    assert shown.sizes.keys() == {first, second}
    assert shown.pending == 4
    again = session.perform(session.acts.relabel(first, "ghost"))
    assert "shows" in session.previewer.full(again.entries).error


def test_things_that_were_merged_can_be_split_at_once(session):
    """Two things that were cut along a wrong line: merge, then click what is what, before Apply."""
    pointer = session.previewer.pointer()
    owner, points = np.asarray(pointer.found.vertex_instance), np.asarray(pointer.surface.vertices, float)
    first, second = (o.id for o in session.bundle.objects[:2])
    spots = [[click(i, points[np.flatnonzero(owner == i)[0]])] for i in (first, second)]
    with pytest.raises(UsageError, match="all clicks must be on one thing"):
        session.acts.split(spots)
    session.perform(session.acts.merge([first, second]))
    state = session.perform(session.acts.split(spots))
    assert session.previewer.full(state.entries).error == ""
    after = Overrides(state.entries).apply_to_instances(pointer)
    assert len(after.objects) == len(pointer.found.objects)


def test_wrong_clicks_are_said(session):
    acts, number = session.acts, session.bundle.objects[0].id
    spot = session.bundle.objects[0].world_from_object[:3, 3]
    with pytest.raises(UsageError, match="select two things"):
        acts.merge([number])
    with pytest.raises(UsageError, match="all clicks must be on one thing"):
        acts.split([[click(number, spot)], [click(number + 1, spot)]])
    with pytest.raises(UsageError, match="cannot carry itself"):
        acts.parent(number, number)
    with pytest.raises(UsageError, match="at least 3 points"):
        acts.add("mug", [Outline(0, ((1, 1), (2, 2)))])
    with pytest.raises(UsageError, match="three lengths in metres"):
        acts.size(number, [0.1, 0.2, 30])
    with pytest.raises(UsageError, match="type a name"):
        acts.relabel(number, "\x07 \n")


@given(
    st.one_of(st.text(max_size=200), st.sampled_from(["<img src=x>", "a\x00\x1b[2J", "‮gnp", "]: {", "# x"]))
)
def test_hostile_labels_are_one_line_of_valid_yaml(label):
    from studio.correcting.yaml_text import appended, entries_of

    new = one_line(label)
    text = appended("# head\n", {"id": 3, "relabel": new}, f"{label} 3")
    assert entries_of(text) == yaml.safe_load(text) == [{"id": 3, "relabel": new}]
    assert text.count("\n") == 2
    assert all(c.isprintable() for c in text.replace("\n", ""))


def test_the_list_of_acts_is_text(session):
    number = session.bundle.objects[0].id
    state = session.perform(session.acts.relabel(number, "<script>alert(1)</script>"))
    assert "<script>alert(1)</script>" in words_of(state)[0]
    from studio.text import plain_markdown

    assert "<" not in plain_markdown(words_of(state)[0])
