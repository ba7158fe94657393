"""Bundles made to harm are refused in one line, quickly, in little memory; nothing outside is read or written."""

import json
import subprocess
import sys
import time
from pathlib import Path

import hostile
import numpy as np
import pytest

from registry import BundleError, SceneBundle, SceneRegistry
from registry.plain_text import is_plain
from synthetic.small_bundle import OBJ_TEXT, SCENE, TRIANGLE, pack_glb, triangle_document

pytestmark = pytest.mark.stage

MAX_SECONDS, MAX_MB = 2.0, 500  # of processor time, because tests share the machine
GLB = "objects/002/visual.glb"
OBJ = "objects/002/collision_000.obj"


def _glb(change, binary=TRIANGLE):
    """Return a change of a bundle: the mesh of an object, from a change of the glTF document."""

    def write(folder):
        document = triangle_document()
        found = change(document)
        content, data = found if isinstance(found, tuple) else (document if found is None else found, binary)
        (folder / GLB).write_bytes(pack_glb(content, data))

    return write


def _set(place, value):
    return _glb(lambda document: hostile.put(document, place, value))


def _obj(text):
    return lambda folder: (folder / OBJ).write_bytes(text if isinstance(text, bytes) else text.encode())


def _text(old, new):
    """Return a change of the JSON text of a mesh."""
    return _glb(lambda document: json.dumps(document).replace(old, new))


def _pictured(picture):
    return _glb(lambda document: hostile.textured(document, picture, TRIANGLE))


NAN = hostile.floats(float("nan"), *[0] * 8) + TRIANGLE[36:]
HUGE = hostile.floats(1e30, *[0] * 8) + TRIANGLE[36:]
BEYOND = TRIANGLE[:36] + np.array([0, 1, 9], "<u4").tobytes()
MESHES = {
    "another file": (_set("buffers[0].uri", "../../secret.bin"), "names another file"),
    "absolute file": (_set("buffers[0].uri", "/etc/passwd"), "names another file"),
    "file URL": (_set("images", [{"uri": "file:///etc/passwd"}]), "names another file"),
    "data URI": (_set("buffers[0].uri", "data:;base64,AAAA"), "names another file"),
    "duplicate key": (_text('"buffers": [{', '"buffers": [{"uri": "/etc/passwd"}], "buffers": [{'), "twice"),
    "escaped duplicate": (_text('{"byteLength": 48', '{"u": 1, "\\u0075": 2, "byteLength": 48'), "twice"),
    "NaN in JSON": (_text('"count": 3', '"count": NaN'), "strict JSON"),
    "infinite in JSON": (_set("nodes[0].translation", [1e300, 0, 0]), "numbers within"),
    "nodes 2^40": (_glb(lambda d: hostile.put(d, "nodes", hostile.node_graph(40))), "used twice"),
    "node cycle": (_set("nodes", [{"children": [1], "mesh": 0}, {"children": [0]}]), "used twice"),
    "deep nodes": (
        _set("nodes", [*({"children": [i + 1]} for i in range(900)), {"mesh": 0}]),
        "nested more than",
    ),
    "many nodes": (_set("nodes", [{"mesh": 0}] * 200_000), "more than"),
    "many accessors": (_set("accessors", [{"bufferView": 0}] * 200_000), "more than"),
    "accessor beyond": (_set("accessors[0].count", 4), "do not fit"),
    "accessor without data": (_set("accessors[0]", {"componentType": 5126, "count": 3, "type": "VEC3"}), "bufferView"),
    "huge count": (_set("accessors[0].count", 2**40), "whole number"),
    "sparse accessor": (_set("accessors[0].sparse", {"count": 1}), "not allowed"),
    "negative offset": (_set("bufferViews[0].byteOffset", -4), "whole number"),
    "view beyond": (_set("bufferViews[1].byteLength", 4000), "whole number"),
    "index beyond": (_glb(lambda d: None, BEYOND), "index 9 of 3"),
    "vertex NaN": (_glb(lambda d: None, NAN), "finite numbers"),
    "vertex far away": (_glb(lambda d: None, HUGE), "finite numbers"),
    "mesh index": (_set("nodes[0].mesh", 7), "whole number"),
    "mesh true": (_set("nodes[0].mesh", True), "whole number"),
    "extension": (_set("extensionsRequired", ["KHR_draco_mesh_compression"]), "not allowed"),
    "skin": (_set("skins", [{}]), "not allowed"),
    "lines not triangles": (_set("meshes[0].primitives[0].mode", 1), "whole number"),
    "no mesh": (_set("nodes", [{}]), "no mesh"),
    "texture 16000": (_pictured(hostile.png(16_000, 16_000, b"")), "16000 x 16000 pixels"),
    "texture no PNG": (_pictured(b"GIF89a" + bytes(60)), "not a PNG"),
    "truncated": (lambda f: (f / GLB).write_bytes((f / GLB).read_bytes()[:-8]), "not a binary glTF"),
    "bytes after the end": (
        lambda f: (f / GLB).write_bytes(pack_glb(triangle_document(), TRIANGLE + bytes(64))), "binary chunk has",
    ),
    "deep JSON": (_glb(lambda d: "[" * 40_000), "nested|not JSON|lists"),
    "JSON bomb": (_glb(lambda d: '{"extras":[' + "[]," * 1_000_000 + "[]]}"), "lists and objects"),
    "OBJ number": (_obj(OBJ_TEXT.replace("1 0 0", "1 x 0")), "malformed"),
    "OBJ NaN": (_obj(OBJ_TEXT.replace("1 0 0", "nan 0 0")), "malformed"),
    "OBJ huge": (_obj(OBJ_TEXT.replace("1 0 0", "1e30 0 0")), "coordinate"),
    "OBJ index": (_obj(OBJ_TEXT + "f 1 2 99\n"), "vertex 99 of 4"),
    "OBJ index 0": (_obj(OBJ_TEXT + "f 0 1 2\n"), "malformed"),
    "OBJ material": (_obj("mtllib /etc/passwd\n" + OBJ_TEXT), "not allowed"),
    "OBJ continued line": (_obj("# a \\\nmtllib x\n" + OBJ_TEXT), "malformed|not allowed"),
    "OBJ not text": (_obj(b"# \xff\n" + OBJ_TEXT.encode()), "malformed|not allowed"),
    "OBJ many vertices": (_obj("v 0 0 0\n" * 300_000), "more than"),
}  # fmt: skip

SCENES = {
    "rate is a text": ("report.physics.stable_rate", "x", "a number"),
    "rate of 7": ("report.physics.stable_rate", 7, "between 0 and 1"),
    "depth is a list": ("report.physics.spawn_penetration_mm", [1], "a number"),
    "physics objects": ("report.physics.objects", [{"name": 3}], "missing"),
    "timings": ("report.timings_s", {"frames": "long"}, "a number"),
    "notes": ("report.notes", "abc", "a list"),
    "versions": ("report.volatile", {"versions": {"numpy": 3}}, "a text"),
    "cpu": ("report.volatile", {"cpu_s": {"frames": None}}, "a number"),
    "digest is a path": ("report.volatile", {"work": {"input_digest": "../../x", "stage_keys": {}}}, "hexadecimal"),
    "stage key is a path": (
        "report.volatile", {"work": {"input_digest": "ab" * 32, "stage_keys": {"frames": "/x"}}}, "hexadecimal",
    ),
    "registration": ("report.registration", {"registered": "all"}, "whole number"),
    "escape in a label": ("objects[0].label", "cup\x1b[2J", "control character"),
    "escape in a file": ("source.file", "a\x1b]0;x\x07.mp4", "control character"),
    "newline in a label": ("objects[0].label", "cup\n- drop: 3", "one line"),
    "C1 control": ("objects[0].material", "wood\x9b2J", "control character"),
    "text direction": ("objects[0].label", "a\u202eb", "control character"),
    "half a pair": ("objects[0].label", "a\ud800b", "control character"),
    "escape deep inside": ("graph.steps", [{"said": [{"x": "\x1b[0m"}]}], "control character"),
    "escape in a key": ("report.config", {"a\x1b[0m": 1}, "control character"),
    "uncertainty": ("scale.uncertainty", "small", "a number"),
    "picture size": ("cameras.width", 2**30, "32768"),
    "views": ("objects[0].views", ["x"], "number of a frame"),
    "large number": ("objects[0].views", [10**60], "digits"),
}  # fmt: skip


def _refused(folder: Path, match: str) -> str:
    """Check that opening raises one plain line in time, however hashes are checked."""
    for check_hashes in (False, True):
        start = time.process_time()
        with pytest.raises(BundleError, match=match) as caught:
            SceneBundle.open(folder, check_hashes=check_hashes)
        assert time.process_time() - start < MAX_SECONDS
    assert is_plain(str(caught.value))
    assert len(str(caught.value)) < 1000
    return str(caught.value)


@pytest.mark.parametrize("kind", MESHES)
def test_a_hostile_mesh_is_refused_on_every_load(make_staging, kind):
    folder = make_staging()
    change, match = MESHES[kind]
    change(folder)
    hostile.reseal(folder)
    assert "objects/002" in _refused(folder, match)


@pytest.mark.parametrize("kind", SCENES)
def test_a_hostile_scene_is_refused_on_every_load(make_staging, scene, kind):
    folder = make_staging()
    place, value, match = SCENES[kind]
    hostile.put(scene, place, value)
    hostile.reseal(folder, json.dumps(scene))
    _refused(folder, match)


@pytest.mark.parametrize("kind", ["link", "pipe", "socket", "folder"])
def test_a_mesh_that_is_no_plain_file_is_refused(make_staging, tmp_path, kind):
    folder = make_staging()
    secret = tmp_path / "secret.glb"
    secret.write_bytes((folder / GLB).read_bytes())
    hostile.replace_by(kind, secret)(folder)
    _refused(folder, "symbolic link|not a plain file|not in the folder")


def test_a_linked_folder_and_a_linked_bundle_are_refused(make_staging, tmp_path):
    folder = make_staging()
    (tmp_path / "whole").symlink_to(folder)
    _refused(tmp_path / "whole", "symbolic link")
    hostile.linked_folder(folder, tmp_path / "moved")
    _refused(folder, "symbolic link")


def _chain(scene):
    hostile.chained(scene, 1500)


def _crowd(scene):
    hostile.many_objects(scene, 20_000)


def _values(scene):
    scene["report"]["config"] = {"x": [[]] * 4_000_000}


HEAVY = {
    "chain of 1500": (_chain, "edges away"),
    "20,000 objects": (_crowd, "at most|lists"),
    "values": (_values, "lists"),
}


@pytest.mark.parametrize("kind", [*HEAVY, "nodes 2^40", "texture 16000", "JSON bomb", "PNG bomb"])
def test_a_bomb_is_refused_in_little_memory(make_staging, scene, kind):
    folder = make_staging()
    if kind in HEAVY:
        HEAVY[kind][0](scene)
        hostile.reseal(folder, json.dumps(scene, separators=(",", ":")))
        match = HEAVY[kind][1]
    else:
        change, match = MESHES.get(kind, (_pictured(hostile.bomb_png()), "holds more than"))
        change(folder)
        hostile.reseal(folder)
    code = (
        "import re, sys, time\nfrom pathlib import Path\nfrom registry import BundleError, SceneBundle\n"
        "start = time.process_time()\ntry:\n    SceneBundle.open(Path(sys.argv[1]))\nexcept BundleError as error:\n"
        "    print(error)\nprint(time.process_time() - start)\n"
        # Not ru_maxrss, which a child inherits from its parent.
        "print(int(re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text()).group(1)) / 1024)\n"
    )
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        [sys.executable, "-c", code, str(folder)],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
        cwd=root,
    )
    *said, seconds, peak_mb = done.stdout.splitlines()
    assert len(said) == 1
    assert any(word in said[0] for word in match.split("|"))
    assert float(seconds) < MAX_SECONDS
    assert float(peak_mb) < MAX_MB


def test_publishing_a_hostile_bundle_changes_nothing(make_staging, tmp_path):
    folder = make_staging()
    MESHES["another file"][0](folder)
    hostile.reseal(folder)
    registry = SceneRegistry(tmp_path / "registry")
    with pytest.raises(BundleError):
        registry.publish(folder, "scene0001")
    assert not registry.root.exists()


def test_an_ordinary_bundle_opens(make_staging):
    folder = make_staging()
    _pictured(hostile.png(64, 32))(folder)
    hostile.reseal(folder)
    assert SceneBundle.open(folder).scene == SCENE
