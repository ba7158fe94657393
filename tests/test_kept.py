"""Results of slow fixtures are kept, shared, and made anew when files change."""

import shutil

import kept
import pytest

made = []


def numbers() -> list[int]:
    made.append(1)
    return [1, 2, 3]


def text(folder) -> None:
    made.append(1)
    (folder / "a.txt").write_text("a")
    if len(made) == 1:
        raise ValueError("the first time fails")


@pytest.fixture(autouse=True)
def root(tmp_path, monkeypatch):
    """Keep results in a copy of this folder of tests."""
    made.clear()
    for package in ("registry", "tests"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "module.py").write_text("x = 1\n")
    monkeypatch.setattr(kept, "ROOT", tmp_path)
    monkeypatch.setattr(kept, "_place", lambda make: (make.__name__, tmp_path / "tests"))
    kept._digest.cache_clear()
    yield tmp_path
    kept._digest.cache_clear()


def test_a_result_is_made_once_until_a_file_changes(root):
    assert kept.kept(numbers) == kept.kept(numbers) == [1, 2, 3]
    assert len(made) == 1
    (root / "registry" / "module.py").write_text("x = 2\n")
    kept._digest.cache_clear()
    assert kept.kept(numbers) == [1, 2, 3]
    assert len(made) == 2
    assert len(list((root / ".pytest_cache" / "kept" / "numbers").iterdir())) == 1
    shutil.rmtree(root / ".pytest_cache")
    assert kept.kept(numbers) == [1, 2, 3]
    assert len(made) == 3


def test_an_error_leaves_nothing_behind():
    with pytest.raises(ValueError, match="first time"):
        kept.kept_folder(text)
    folder = kept.kept_folder(text)
    assert (folder / "a.txt").read_text() == "a"
    assert kept.kept_folder(text) == folder
    assert len(made) == 2
