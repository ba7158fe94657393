"""Overrides files with accidents and traps in them: refused when they are loaded, in one message."""

import time
from pathlib import Path

import pytest

from reconstruction.editing.overrides import Overrides
from registry.errors import UsageError

ALIASES = "- &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"- &{chr(98 + k)} [{', '.join(['*' + chr(97 + k)] * 9)}]\n" for k in range(9)
)
NESTED = "- &a0 [x]\n" + "".join(f"- &a{k + 1} [[[[*a{k}]]]]\n" for k in range(10))
MERGED = "- &a0 {id: 3, drop: true}\n" + "".join(
    f"- &a{k + 1} {{<<: [*a{k}, *a{k}, *a{k}]}}\n" for k in range(20)
)

FILES: dict[str, tuple[bytes, str]] = {
    "not UTF-8": (b"- {id: 3, relabel: \xe9tag\xe8re}\n", "not UTF-8 text: line 1 has the byte 0xe9"),
    "UTF-16": ("- {id: 3, relabel: mug}\n".encode("utf-16"), "not UTF-8"),
    "binary": (bytes(range(256)), "not UTF-8|not valid YAML"),
    "null bytes": (b"- {id: 3, relabel: \0}\n", "not valid YAML"),
    "deep lists": (b"[" * 100_000, "nested more than 32"),
    "deep mappings": (b"{a: " * 5000, "nested more than 32"),
    "aliases of aliases": (ALIASES.encode(), "more than 200000 values, with aliases written out"),
    "aliases that nest": (NESTED.encode(), "nested more than 32"),
    "an alias of itself": (b"- &a {id: 3, split: *a}\n", "for itself"),
    "merged keys": (MERGED.encode(), "more than 200000 values|comes twice|unknown"),
    "large": (b"# " + b"x" * (5 << 20), "larger than 4 MB"),
    "a tag that runs code": (b"- !!python/object/apply:os.system ['true']\n", "not valid YAML"),
    "a key twice": (b"- {id: 3, id: 4, drop: true}\n", "'id' comes twice"),
    "a list as key": (b"- {[1, 2]: 3}\n", "not valid YAML"),
    "text": (b"drop everything", "expected a list"),
    "a mapping": (b"{id: 3, drop: true}", "expected a list"),
}

ENTRIES: dict[str, str] = {
    "drop: 'no'": "drop must be true",
    "drop: no": "drop must be true",
    "drop: 1": "drop must be true",
    "drop: {}": "drop must be true",
    "relabel: 5": "relabel must be text",
    "relabel: no": "relabel must be text",
    "relabel: [mug]": "relabel must be text",
    "relabel: ''": "relabel must be one line",
    "relabel: 2020-01-01": "relabel must be text",
    'relabel: "a\\e[31mb"': "relabel must be one line",
    'relabel: "a\\nb"': "relabel must be one line",
    "material: zzz": "no material 'zzz'; there are ceramic",
    "material: wod": "Did you mean 'wood'",
    "material: [wood]": "material must be text",
    "mass_kg: .nan": "mass_kg must be a positive number",
    "mass_kg: -1": "mass_kg must be a positive number",
    "mass_kg: true": "mass_kg must be a positive number",
    f"mass_kg: 1{'0' * 400}": "mass_kg must be a positive number",
    "friction: .inf": "friction must be a positive number",
    "friction: '0.5'": "friction must be a positive number",
    "mesh: nothing.obj": "there is no file .*nothing.obj",
    "mesh: .": "there is no file",
    'mesh: "a\\0b"': "mesh must be one line",
    "mesh: 7": "mesh must be text",
    "dynamic: 'yes'": "dynamic must be true or false",
    "make_base: roof": "make_base must be one of floor, wall, ceiling",
    "make_base: [floor]": "make_base must be one of",
    "split: 2": "split needs a plane",
    "split: {point: [0, 0, 0]}": "split needs a plane",
    "split: {point: [0, 0, .nan], normal: [1, 0, 0]}": "point must be three numbers",
    "split: {point: [0, 0, 1], normal: [0, 0, 0]}": "has no direction",
    "move: {by: ['1', '2', '3']}": "by must be three numbers",
    "move: {by: [true, 0, 0]}": "by must be three numbers",
    f"move: {{by: [1{'0' * 400}, 0, 0]}}": "by must be three numbers",
    f"move: {{turn_deg: 1{'0' * 400}}}": "turn_deg must be a number",
    "drop: true, relabel: mug": "drop cannot be combined with relabel",
    "make_base: wall, mass_kg: 1": "make_base cannot be combined with mass_kg",
    "parent: {pixel: {frame: 1, x: 1, y: 1, size: [0, 0]}}": "pixel needs",
    "parent: {pixel: {frame: .inf, x: 1, y: 1}}": "pixel needs",
    "parent: '3'": "needs one of `id: N`",
    "id: true, drop: true": "comes twice",
    "near: [0, 0, x], drop: true": "near must be three numbers",
    "5: 6, drop: true": "unknown '5'",
}


def refused(path: Path, says: str) -> str:
    started = time.perf_counter()
    with pytest.raises(UsageError, match=says) as caught:
        Overrides.load(path)
    assert time.perf_counter() - started < 5
    message = str(caught.value)
    assert message.startswith(f"--overrides {path}")
    assert len(message) < 800
    assert message.replace("\n", "").isprintable()
    return message


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_is_no_list_of_entries_is_refused(name, tmp_path):
    data, says = FILES[name]
    path = tmp_path / "fixes.yaml"
    path.write_bytes(data)
    refused(path, says)


@pytest.mark.parametrize("entry", ENTRIES)
def test_a_value_that_an_action_cannot_have_is_refused(entry, tmp_path):
    path = tmp_path / "fixes.yaml"
    path.write_text(f"- {{id: 1, relabel: box}}\n- {{id: 3, {entry}}}\n")
    message = refused(path, ENTRIES[entry])
    assert "entry 2" in message or "line 2" in message


def test_a_value_of_a_megabyte_is_not_printed(tmp_path):
    path = tmp_path / "fixes.yaml"
    path.write_text(f"- {{id: 3, move: {'x' * 1_000_000}}}\n")
    refused(path, "move needs")


@pytest.mark.parametrize("name", ["missing.yaml", "."])
def test_a_file_that_cannot_be_read_is_named(name, tmp_path):
    with pytest.raises(UsageError, match=r"No such file|Is a directory"):
        Overrides.load(tmp_path / name)


def test_aliases_of_programs_that_write_yaml_are_read(tmp_path):
    path = tmp_path / "fixes.yaml"
    path.write_text("- {merge: [&a {pixel: {frame: 1, x: 2, y: 3}}, {id: 4}]}\n- {merge: [*a, {id: 5}]}\n")
    assert Overrides.load(path).entries[1]["merge"][0] == {"pixel": {"frame": 1, "x": 2, "y": 3}}


def test_what_is_right_still_loads(tmp_path):
    (tmp_path / "mug.obj").write_text("v 0 0 0\n")
    path = tmp_path / "fixes.yaml"
    text = (
        "\ufeff# mine\n- {id: 3, relabel: Étagère, material: wood, mass_kg: 2, mesh: mug.obj}\n"
        "- {id: 4, drop: true}\n- {id: 5, make_base: wall}\n- {id: 6, split: {point: [0, 0, 1], normal: [0, 0, 1]}}\n"
    )
    path.write_text(text, encoding="utf-8")
    assert len(Overrides.load(path).entries) == 4
