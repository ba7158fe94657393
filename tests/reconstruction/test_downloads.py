"""Videos at addresses are downloaded once, whole or not at all, and again when they have changed."""

import fsspec
import pytest

from reconstruction.downloads import as_local, drop_copy, local_copy
from registry.errors import EnvironmentMissing, UsageError

pytestmark = pytest.mark.stage


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("SIMRECON_HOME", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.fixture(params=["memory", "s3"])
def address(request, tmp_path) -> str:
    if request.param == "s3":
        request.getfixturevalue("s3")
        return f"s3://lab/films/{tmp_path.name}"
    return f"memory://films/{tmp_path.name}"


def put(address: str, content: bytes) -> None:
    fs, path = fsspec.core.url_to_fs(address)
    fs.pipe_file(path, content)


def test_a_film_is_downloaded_once_and_again_when_it_has_changed(address, home):
    film, said = f"{address}/room.mp4", []
    put(film, b"a film")
    first = local_copy(film, said.append)
    assert (first.name, first.read_bytes()) == ("room.mp4", b"a film")
    assert local_copy(film, said.append) == as_local(film) == first
    assert len(said) == 1
    put(film, b"another one")
    assert local_copy(film, said.append).read_bytes() == b"another one"
    assert len(said) == 2
    drop_copy(film)
    assert [path.read_bytes() for path in home.rglob("room.mp4")] == [b"a film"]


def test_a_folder_of_images_is_downloaded_with_the_folders_in_it(address):
    for name in ("1.jpg", "2.jpg", "keyframes/depth/1.png"):
        put(f"{address}/photos/{name}", name.encode())
    folder = local_copy(f"{address}/photos/")
    assert folder.name == "photos"
    found = {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }
    assert found == {name: name.encode() for name in ("1.jpg", "2.jpg", "keyframes/depth/1.png")}


def test_a_download_that_breaks_off_leaves_nothing(home, monkeypatch):
    address = "memory://films/broken"
    for name in ("1.jpg", "2.jpg"):
        put(f"{address}/photos/{name}", b"x")
    fs = fsspec.core.url_to_fs(address)[0]
    get = type(fs).get_file

    def breaks(self, path, *args, **kwargs):
        if path.endswith("2.jpg"):
            raise ConnectionResetError("the network is down")
        return get(self, path, *args, **kwargs)

    monkeypatch.setattr(type(fs), "get_file", breaks)
    with pytest.raises(EnvironmentMissing, match="the network is down"):
        local_copy(f"{address}/photos")
    assert not list((home / "videos").iterdir())


@pytest.mark.parametrize("name", ["nothing.mp4", "no/such/folder"])
def test_nothing_at_an_address_is_wrong_use(address, name):
    with pytest.raises(UsageError, match="no such file"):
        local_copy(f"{address}/{name}")


def test_a_home_that_cannot_be_written_is_named(monkeypatch):
    monkeypatch.setenv("SIMRECON_HOME", "/dev/null/home")
    put("memory://films/room.mp4", b"x")
    with pytest.raises(EnvironmentMissing, match="SIMRECON_HOME"):
        local_copy("memory://films/room.mp4")


def test_a_path_stays_as_it_is(tmp_path):
    assert as_local(tmp_path / "room.mp4") == as_local(str(tmp_path / "room.mp4")) == tmp_path / "room.mp4"
