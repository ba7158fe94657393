"""The stage cache: equal inputs hit, each changed input misses, and nothing partial ever looks finished."""

import dataclasses
import os
import subprocess
import sys

import pytest

from reconstruction.cache import (
    KEPT_PER_STAGE,
    StageStore,
    canonical_json,
    digest_input,
    fingerprint,
)
from reconstruction.core.types import Edge, SceneGraph
from registry.errors import EnvironmentMissing

pytestmark = pytest.mark.stage

GRAPH = SceneGraph(edges=(Edge(1, "supported_by", 0, 1.0, ""),))
CODE = ["a digest"]


@dataclasses.dataclass(frozen=True)
class _Config:
    limit: int = 3
    name: str = "a"


def test_fingerprint_depends_on_everything_that_goes_in():
    base = fingerprint("frames", CODE, _Config(), ("abc",))
    assert base == fingerprint("frames", CODE, _Config(), ("abc",))
    others = {
        fingerprint("poses", CODE, _Config(), ("abc",)),
        fingerprint("frames", ["another"], _Config(), ("abc",)),
        fingerprint("frames", CODE, _Config(limit=4), ("abc",)),
        fingerprint("frames", CODE, _Config(name="b"), ("abc",)),
        fingerprint("frames", CODE, _Config(), ("abd",)),
        fingerprint("frames", CODE, _Config(), ("abc", "x")),
    }
    assert base not in others
    assert len(others) == 6


def test_canonical_json_ignores_order_and_refuses_nan():
    assert canonical_json({"b": 1, "a": _Config()}) == canonical_json({"a": _Config(), "b": 1})
    with pytest.raises(ValueError, match="JSON"):
        canonical_json({"a": float("nan")})


def test_a_stage_is_finished_only_after_save(tmp_path):
    store = StageStore(tmp_path)
    assert not store.has(8, "scene_graph", "k1")
    store.save(GRAPH, 8, "scene_graph", "k1", {"note": "x"})
    assert store.has(8, "scene_graph", "k1")
    assert store.load(SceneGraph, 8, "scene_graph", "k1") == GRAPH
    assert store.manifest(8, "scene_graph", "k1") == {"note": "x"}
    assert not list(tmp_path.glob("tmp-*"))


def test_old_fingerprints_are_pruned_but_the_last_ones_stay(tmp_path):
    store = StageStore(tmp_path)
    for number in range(4):
        store.save(GRAPH, 8, "scene_graph", f"k{number}", {})
        folder = tmp_path / f"08_scene_graph-k{number}"
        os.utime(folder, (1000 + number, 1000 + number))
    kept = sorted(p.name for p in tmp_path.iterdir())
    assert kept == [f"08_scene_graph-k{n}" for n in range(4 - KEPT_PER_STAGE, 4)]


def test_leftovers_of_a_dead_process_are_swept_and_of_a_living_one_kept(tmp_path):
    dead = subprocess.run(
        [sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True, check=True
    )
    (tmp_path / f"tmp-{dead.stdout.strip()}-poses").mkdir()
    (tmp_path / "tmp-1-poses").mkdir()  # pid 1 always lives
    StageStore(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["tmp-1-poses"]


def test_work_folder_that_cannot_be_made_is_a_clear_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(EnvironmentMissing, match="--work-dir"):
        StageStore(tmp_path / "file" / "work")


def test_digest_of_a_folder_depends_on_names_and_bytes(tmp_path):
    (tmp_path / "a.png").write_bytes(b"1")
    first = digest_input(tmp_path)
    (tmp_path / "a.png").rename(tmp_path / "b.png")
    second = digest_input(tmp_path)
    (tmp_path / "b.png").write_bytes(b"2")
    assert len({first, second, digest_input(tmp_path)}) == 3
