"""Every kind of mistake in a scene.json raises an error that names its place."""

import numpy as np
import pytest

from registry import BundleError, UsageError, check_scene_id, validate_scene
from registry.schema import referenced_files


def put(scene: dict, place: str, value: object) -> None:
    """Set the value at a JSON place such as `objects[0].mass_kg`."""
    target = scene
    keys = [int(k) if k.isdigit() else k for k in place.replace("[", ".").replace("]", "").split(".")]
    for key in keys[:-1]:
        target = target[key]
    target[keys[-1]] = value


SCALED = np.diag([1.1, 1.1, 1.1, 1.0]).tolist()
MIRRORED = np.diag([-1.0, 1, 1, 1]).tolist()
BAD_ROW = [*np.eye(4).tolist()[:3], [0, 0, 0.1, 1]]
FAR = (np.eye(4) + np.array([[0, 0, 0, 1e6]] + [[0] * 4] * 3)).tolist()
BALL = {"shape": "sphere", "size": [0.1], "object_from_primitive": np.eye(4).tolist()}
MISTAKES = [
    ("schema", "simrecon.scene/2", "upgrade"),
    ("schema", "other", "expected"),
    ("schema", None, "got nothing"),
    ("id", "Scene 1", "a scene id"),
    ("source.sha256", "AB", "64 hexadecimal"),
    ("source.width", 0, "at least 1"),
    ("source.fps", -1, "at least 0"),
    ("source.frame_count", 1.5, "whole number"),
    ("scale.uncertainty", -0.1, "at least 0"),
    ("scale.method", "", "text"),
    ("cameras.model", "FISHEYE", "PINHOLE"),
    ("cameras.params", [500, 500, 320], "4 finite numbers"),
    ("cameras.params", [500, 500, 320, float("nan")], "finite"),
    ("cameras.params", [-500, 500, 320, 240], "focal"),
    ("cameras.frames[1].index", 0, "used twice"),
    ("cameras.frames[2].world_from_camera", SCALED, "rigid"),
    ("base[0].label", "roof", "floor"),
    ("base[0].plane", [0, 0, 2, 0], "unit normal"),
    ("base[0].observed", 1, "true or false"),
    ("base[0].mesh", "../floor.glb", "relative path"),
    ("base[0].mesh", "base/floor.pkl", ".glb"),
    ("base[0].collision[0]", "/floor.obj", "relative path"),
    ("base[0].observed_fraction", 1.5, "between 0 and 1"),
    ("backdrop", {"mesh": "../far.glb", "observed_fraction": 0.5}, "relative path"),
    ("backdrop", {"mesh": "backdrop.glb", "observed_fraction": -1}, "between 0 and 1"),
    ("objects", {}, "a list"),
    ("objects[0]", [], "an object"),
    ("objects[1].id", 2, "used twice"),
    ("objects[1].id", 1, "used twice"),
    ("objects[1].id", "2", "whole number"),
    ("objects[1].id", True, "whole number"),
    ("objects[1].collision_primitives", [], "one for each collision part"),
    ("objects[1].collision_primitives", [{**BALL, "shape": "cone"}], '"sphere"'),
    ("objects[1].collision_primitives", [{**BALL, "shape": ["box"]}], '"sphere"'),
    ("objects[1].collision_primitives", [{**BALL, "size": [0.1, 0.1]}], "1 finite numbers"),
    ("objects[1].collision_primitives", [{**BALL, "size": [0.0]}], "above 0"),
    ("objects[1].collision_primitives", [{**BALL, "object_from_primitive": SCALED}], "rigid"),
    ("objects[1].mass_kg", -1, "expected a positive number of at most 1e+07, got -1"),
    ("objects[1].mass_kg", 0, "positive"),
    ("objects[1].mass_kg", "3", "positive"),
    ("objects[1].mass_kg", 10**400, "positive"),
    ("objects[1].density_kg_m3", float("inf"), "positive"),
    ("objects[1].friction", -0.1, "between 0 and 100"),
    ("objects[1].restitution", 1.5, "between 0 and 1"),
    ("objects[1].ranges.mass_kg", [4.0, 5.0], "low and high around mass_kg 3.5"),
    ("objects[1].ranges.friction", [0.7, 0.4], "low and high around friction 0.6"),
    ("objects[1].ranges.friction", [0.7], "2 finite numbers"),
    ("objects[1].ranges.color", [0, 1], "one of mass_kg, friction, restitution"),
    ("objects[1].label_confidence", 2, "between 0 and 1"),
    ("objects[1].scale", [1, 0, 1], "positive extents"),
    ("objects[1].center_of_mass", [0, 0], "3 finite"),
    ("objects[1].inertia", [[1, 0, 0], [0, -1, 0], [0, 0, 1]], "positive definite"),
    ("objects[1].inertia", [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]], "symmetric"),
    ("objects[1].world_from_object", SCALED, "rigid"),
    ("objects[1].world_from_object", MIRRORED, "reflection"),
    ("objects[1].world_from_object", BAD_ROW, "last row"),
    ("objects[1].world_from_object", FAR, "within"),
    ("objects[1].world_from_object", [1, 2, 3], "4 rows"),
    ("objects[1].visual", "objects\\003\\visual.glb", "relative path"),
    ("objects[1].collision", [], "dynamic"),
    ("objects[1].collision[0]", 7, "relative path"),
    ("objects[1].dynamic", "yes", "true or false"),
    ("objects[1].relation_fixed", 0, "true or false"),
    ("objects[1].provenance.observed_fraction", 1.1, "between 0 and 1"),
    ("objects[1].provenance", None, "an object"),
    ("objects[1].views", 3, "a list"),
    ("graph.edges[0].child", 9, "id of an object"),
    ("graph.edges[0].child", 1, "id of an object"),
    ("graph.edges[0].parent", 9, "object or base"),
    ("graph.edges[1].child", 3, "second parent"),
    ("graph.edges[0].relation", "on", "supported_by"),
    ("graph.edges[0].confidence", None, "between 0 and 1"),
    ("report.physics", [], "an object"),
    ("report.peak_memory_mb", -5, "at least 0"),
]


@pytest.mark.parametrize(("place", "value", "message"), MISTAKES, ids=lambda x: str(x)[:40])
def test_mistakes_are_named_with_their_place(scene, place, value, message):
    put(scene, place, value)
    with pytest.raises(BundleError) as caught:
        validate_scene(scene)
    assert str(caught.value).startswith(place)
    assert message in str(caught.value)


REQUIRED = ["source", "scale", "cameras", "base", "objects", "graph", "report", "graph.edges"]
REQUIRED += ["cameras.frames", "objects[0].mass_kg", "objects[0].world_from_object", "base[0].plane"]


@pytest.mark.parametrize("place", REQUIRED)
def test_missing_fields_are_named(scene, place):
    parent, _, key = place.rpartition(".")
    target = scene
    for part in parent.replace("[", ".").replace("]", "").split(".") if parent else ():
        target = target[int(part) if part.isdigit() else part]
    del target[key]
    with pytest.raises(BundleError, match="missing") as caught:
        validate_scene(scene)
    assert str(caught.value).startswith(place)


def test_the_valid_scene_is_valid(scene):
    validate_scene(scene)


def test_unknown_extra_keys_are_allowed(scene):
    scene["future"] = {"x": 1}
    scene["objects"][0]["future"] = [1]
    scene["schema"] = "simrecon.scene/1.7"
    validate_scene(scene)


def test_a_structure_has_collision_parts_and_no_plane(scene):
    entry = {"id": 99, "label": "structure", "mesh": "base/099_structure.glb", "observed": True}
    scene["base"].append(entry)
    with pytest.raises(BundleError, match="convex parts of the structure"):
        validate_scene(scene)
    entry["collision"] = ["base/099_collision_000.obj"]
    validate_scene(scene)
    assert referenced_files(scene)["base/099_collision_000.obj"] == "base[1].collision[0]"


def test_unknown_scale_may_have_no_uncertainty(scene):
    scene["scale"] = {"method": "unknown", "uncertainty": None}
    validate_scene(scene)


def test_an_object_without_parent_is_refused(scene):
    del scene["graph"]["edges"][1]
    with pytest.raises(BundleError, match="object 2 has none"):
        validate_scene(scene)


def test_a_cycle_is_refused(scene):
    put(scene, "graph.edges[1].parent", 3)
    with pytest.raises(BundleError, match=r"cycle 2 -> 3 -> 2"):
        validate_scene(scene)


@pytest.mark.parametrize("scene_id", ["Kitchen 1", "", "a/b", "../x", "a" * 65, "ä", "a\n"])
def test_bad_scene_ids_get_a_suggestion(scene_id):
    with pytest.raises(UsageError, match="such as"):
        check_scene_id(scene_id)


def test_the_suggestion_is_itself_a_good_id():
    with pytest.raises(UsageError, match="'kitchen_1'"):
        check_scene_id("Kitchen 1!")
    assert check_scene_id("kitchen_1") == "kitchen_1"


def test_frames_of_contact_sheets_are_checked(scene):
    frame = {"index": 3, "image": "instances/00003.jpg", "ids": "instances/00003.png"}
    scene["instances"] = {"frames": [frame]}
    scene["objects"][0]["anchor"] = {"frame": 3, "x": 10.5, "y": 2}
    validate_scene(scene)
    assert set(referenced_files(scene)) >= {"instances/00003.jpg", "instances/00003.png"}
    for key, wrong in (("image", "../x.jpg"), ("ids", "instances/00003.exr"), ("index", -1)):
        scene["instances"]["frames"] = [{**frame, key: wrong}]
        with pytest.raises(BundleError, match=rf"instances.frames\[0\].{key}"):
            validate_scene(scene)
    scene["instances"]["frames"] = [frame]
    scene["objects"][0]["anchor"]["x"] = "left"
    with pytest.raises(BundleError, match=r"objects\[0\].anchor.x"):
        validate_scene(scene)
