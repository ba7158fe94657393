"""Rows from folders and lists: ids, options, and all problems in one message."""

import re
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from reconstruction.batch.listing import read_rows
from reconstruction.batch.naming import assign_ids, id_of_name
from registry.errors import UsageError
from registry.schema import check_scene_id

pytestmark = pytest.mark.unit


def test_a_folder_gives_a_row_for_each_film_and_folder_of_images(films, defaults):
    listing = read_rows(str(films), defaults)
    found = {row.video.name: row.scene_id for row in listing.rows}
    assert found == {"Küche 1.mp4": "kuche_1", "photos": "photos", "room.MOV": "room", "room.mp4": "room_2"}
    assert listing.left_out == ("notes.txt",)
    assert {row.preset for row in listing.rows} == {"fast"}


def test_ids_of_an_earlier_run_stay_when_a_film_comes_before_them(films, defaults):
    known = {str(films / "room.mp4"): "room"}
    found = {row.video.name: row.scene_id for row in read_rows(str(films), defaults, known).rows}
    assert found["room.mp4"] == "room"
    assert found["room.MOV"] == "room_2"


@settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.text(max_size=20), max_size=8, unique=True))
def test_ids_of_any_names_are_valid_and_unique(names):
    videos = [Path("/films", f"{number}") / (name.replace("/", "_").replace("\0", "_") or "x")
              for number, name in enumerate(names)]  # fmt: skip
    ids = assign_ids(videos, {"film": Path("/other")})
    assert len(set(ids.values())) == len(videos)
    for scene_id in ids.values():
        check_scene_id(scene_id)


def test_a_name_without_latin_letters_has_an_id_of_its_own():
    assert re.fullmatch(r"film_[0-9a-f]{8}", id_of_name("厨房"))
    assert id_of_name("厨房") != id_of_name("卧室")


def write(films, *lines: str, name: str = "rooms.csv") -> str:
    path = films / name
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return str(path)


def test_a_list_sets_the_options_of_each_row(films, defaults):
    (films / "fix.yaml").write_text("[]\n")
    address = write(
        films,
        "path,id,preset,options,marker_size,scale,overrides,seed",
        "room.mp4,hall,quality,depth.planes=32 gaussians.iterations=9,0.1,,,7",
        "photos,,,,,camera-height=1.5,,",
    )
    hall, photos = read_rows(address, defaults).rows
    said = hall.arguments()
    assert said[:5] == [str(films / "room.mp4"), "--scene", "hall", "--preset", "quality"]
    assert said[5:] == ["--set", "depth.planes=32", "--set", "gaussians.iterations=9", "--marker-size", "0.1",
                        "--seed", "7"]  # fmt: skip
    assert (photos.scene_id, photos.preset, photos.scale) == ("photos", "fast", "camera-height=1.5")


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_lists_of_spreadsheets_are_read(films, defaults, delimiter):
    path = films / "rooms.csv"
    path.write_bytes(f"\ufeffPath{delimiter} ID\r\nroom.mp4{delimiter}hall\r\n\r\n".encode())
    (row,) = read_rows(str(path), defaults).rows
    assert (row.scene_id, row.video) == ("hall", films / "room.mp4")


def test_all_problems_are_in_one_message_and_in_order(films, defaults):
    address = write(
        films,
        "path,id,preset,marker_size,options,overrides,optoins",
        "no.mp4,Bad Id,fastt,abc,depth.zzz=1,,",
        "room.mp4,hall,,-1,,no.yaml,",
        "room.MOV,hall,,,'x,,",
        ",empty,,,,,",
        "s3://bucket/a.mp4,far,,,,,",
    )
    with pytest.raises(UsageError) as caught:
        read_rows(address, defaults)
    text = str(caught.value)
    for part in (
        "'optoins': unknown. Did you mean 'options'?",
        "line 2, id: scene id 'Bad Id'",
        "line 2, marker_size: 'abc'",
        "line 2, path: ",
        "line 2, preset: unknown preset 'fastt'",
        "line 3, marker_size: -1",
        "line 3, overrides: ",
        "line 4, id: 'hall' is the id of line 3, too",
        "line 4, options: No closing quotation",
        "line 5, path: missing",
        "line 6, path: s3://bucket/a.mp4",
    ):
        assert part in text, part
    lines = [int(n) for n in re.findall(r"^  line (\d+)", text, re.MULTILINE)]
    assert lines == sorted(lines)
    assert "nothing was run" in text


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "must name the columns"),
        ("video,id\nx,y\n", "must name the columns"),
        ("path,id\n", "no row below"),
        ("path,id\nroom.mp4,a,b,c\n", "more cells than columns"),
        ("path,path\nroom.mp4,a\n", "twice"),
        ("path\nroom.mp4\nroom.mp4\n", "give both an id"),
    ],
)
def test_a_malformed_list_is_refused(films, defaults, text, says):
    path = films / "list.csv"
    path.write_text(text)
    with pytest.raises(UsageError, match=says):
        read_rows(str(path), defaults)


def test_no_utf8_no_video_and_no_place_are_refused(films, defaults, tmp_path):
    (films / "latin.csv").write_bytes("path\nK\xfcche.mp4\n".encode("latin-1"))
    (tmp_path / "none").mkdir()
    for address, says in (
        (films / "latin.csv", "UTF-8"),
        (tmp_path / "none", "it is empty"),
        (tmp_path / "gone", "no such file or folder"),
    ):
        with pytest.raises(UsageError, match=says):
            read_rows(str(address), defaults)


def test_the_fingerprint_changes_with_options_and_files_only(films, defaults):
    (films / "fix.yaml").write_text("[]\n")
    address = write(films, "path,id,overrides", "room.mp4,hall,fix.yaml")
    (row,) = read_rows(address, defaults).rows
    first = row.fingerprint()
    assert first == read_rows(address, defaults).rows[0].fingerprint()
    assert first != row.fingerprint(("--require-stable",))
    (films / "fix.yaml").write_text("# changed\n[]\n")
    second = row.fingerprint()
    assert second != first
    (films / "room.mp4").write_bytes(bytes(99))
    assert row.fingerprint() != second
