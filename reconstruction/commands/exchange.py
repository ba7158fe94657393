"""`simrecon pack`, `add`, `push`, `pull`: scenes as files and in shared places."""

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from reconstruction.commands.options import add_common, add_scene, add_verb
from registry import open_registry
from registry.errors import SimReconError, UsageError

if TYPE_CHECKING:
    from registry.exchange import AddedScene, Place, SharedScene

_PLACES = """places (anything that fsspec opens; credentials as its client finds them, docs/sharing.md):
  /mnt/lab/scenes              a folder, also on NFS
  s3://bucket/scenes           S3 and what speaks its protocol (pip install "simrecon[s3]"; AWS_ENDPOINT_URL)
  gs://bucket/scenes           Google Cloud Storage (pip install "simrecon[gs]")
  hf://datasets/me/my-rooms    the Hugging Face Hub (pip install "simrecon[hub]"; `hf auth login`)
  https://host/scenes          a mirror of any of these, read-only
"""
_PACK = """examples:
  simrecon pack my_room                                  my_room.simrecon, in this folder
  simrecon pack my_room -o rooms/ --licence CC-BY-4.0

The same scene gives the same bytes. Textures and pictures in it are photographs of the room: look before you share.
On another machine: simrecon add my_room.simrecon"""
_ADD = """examples:
  simrecon add my_room.simrecon
  simrecon add https://example.org/rooms/my_room.simrecon --as their_room
  python -c 'import gymnasium as gym, simrecon_envs; gym.make(simrecon_envs.add("my_room.simrecon"))'"""
_LISTED_WITH_DETAILS = 100


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Add the verbs."""
    _add_pack(verbs)
    _add_add(verbs)
    _add_push(verbs)
    _add_pull(verbs)


def _add_pack(verbs: argparse._SubParsersAction) -> None:
    parser = add_verb(
        verbs,
        "pack",
        "write a scene to one file, to send it",
        "Write a scene of the registry to one file with its card, checked against its hashes.",
        _PACK,
    )
    add_scene(parser)
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        metavar="FILE",
        help="the file, or a folder for it (default: SCENE.simrecon in this folder)",
    )
    _add_licence(parser)
    add_common(parser)
    parser.set_defaults(run=run_pack)


def _add_add(verbs: argparse._SubParsersAction) -> None:
    parser = add_verb(
        verbs,
        "add",
        "verify a scene from a file, folder or URL, and add it to the registry",
        "Verify a packed scene (or the folder of a bundle) and add it to the registry. Nothing is written there before "
        "every file was checked.",
        _ADD,
    )
    parser.add_argument(
        "source", metavar="FILE|URL|DIR", help="output of `simrecon pack`, or a bundle's folder"
    )
    _add_naming(parser)
    add_common(parser)
    parser.set_defaults(run=run_add)


def _add_push(verbs: argparse._SubParsersAction) -> None:
    parser = add_verb(
        verbs,
        "push",
        "upload scenes to a folder, bucket or hub that others pull from",
        "Upload scenes to a shared place. Many machines may push at once; a killed push leaves nothing half done.",
        _PLACES,
    )
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="scenes of the registry")
    parser.add_argument("place", metavar="PLACE", help="an address, see below")
    parser.add_argument("--all", action="store_true", help="all scenes of the registry")
    parser.add_argument(
        "--catalog",
        action="store_true",
        help="then also write catalog.json, the list that HTTP mirrors of the place are read by",
    )
    _add_licence(parser)
    add_common(parser)
    parser.set_defaults(run=run_push)


def _add_pull(verbs: argparse._SubParsersAction) -> None:
    parser = add_verb(
        verbs,
        "pull",
        "download scenes from a shared place into the registry",
        "Download scenes from a shared place, verify them, and add them to the registry.",
        _PLACES,
    )
    parser.add_argument("place", metavar="PLACE", help="an address, see below")
    parser.add_argument(
        "scenes", nargs="*", metavar="SCENE", help="SCENE, SCENE@REVISION, or a pattern such as 'kitchen_*'"
    )
    parser.add_argument("--list", action="store_true", help="only list what there is (or matches SCENE)")
    parser.add_argument("--all", action="store_true", help="all scenes of the place")
    _add_naming(parser)
    add_common(parser)
    parser.set_defaults(run=run_pull)


def _add_licence(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--licence",
        metavar="NAME",
        help="licence that the card states, such as CC-BY-4.0 (default: what the scene states, else 'not stated')",
    )


def _add_naming(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--as", dest="name", metavar="NAME", help="scene id in the registry (default: its own)"
    )
    parser.add_argument(
        "--replace", action="store_true", help="replace a scene with this id and another revision"
    )


def run_pack(arguments: argparse.Namespace) -> int:
    """Write a pack, and print its path."""
    from registry.exchange import licence_of, pack_scene
    from registry.exchange.pack import with_licence

    bundle = open_registry(arguments.registry).load(arguments.scene)
    packed = pack_scene(bundle, arguments.out, licence=arguments.licence)
    licence = licence_of(with_licence(bundle, arguments.licence))
    if arguments.json:
        facts = {"file": str(packed.path), "scene": packed.scene_id, "revision": packed.revision}
        print(
            json.dumps(
                {**facts, "bytes": packed.bytes, "sha256": packed.sha256, "licence": licence}, indent=2
            )
        )
        return 0
    print(f"{packed.path}: {packed.scene_id}, revision {packed.revision}, {packed.files} files, "
          f"{packed.bytes / 1e6:.1f} MB, licence: {licence}")  # fmt: skip
    print(
        "note: its textures and pictures are photographs of a real room; look for faces and private things first"
    )
    return 0


def run_add(arguments: argparse.Namespace) -> int:
    """Add a scene, and print its environment id."""
    from registry.exchange import add_scene

    registry = open_registry(arguments.registry)
    added = add_scene(arguments.source, registry, scene_id=arguments.name, replace=arguments.replace)
    if arguments.json:
        print(json.dumps(_added_json(added), indent=2))
    else:
        _print_added(added)
    return 0


def run_push(arguments: argparse.Namespace) -> int:
    """Push scenes; print a line for each."""
    from registry.exchange import open_place, push_scene
    from registry.exchange.readme import write_readme
    from registry.exchange.sharing import write_catalog

    if bool(arguments.scenes) + arguments.all > 1 or not (
        arguments.scenes or arguments.all or arguments.catalog
    ):
        raise UsageError("name SCENEs before PLACE, or pass --all for all scenes of the registry")
    registry = open_registry(arguments.registry)
    scenes = list(registry.revisions()) if arguments.all else list(dict.fromkeys(arguments.scenes))
    for scene in scenes:
        registry.get(scene)  # all names are right before anything is uploaded
    place = open_place(arguments.place)
    rows: list[dict] = []
    for scene in scenes:
        pushed = push_scene(registry.load(scene), place, licence=arguments.licence)
        shared = pushed.shared
        rows.append(
            {"scene": scene, "revision": shared.revision, "new": pushed.new, "bytes": pushed.uploaded_bytes}
        )
        if not arguments.json:
            done = (
                f"pushed, {pushed.uploaded_bytes / 1e6:.1f} MB"
                if pushed.uploaded_bytes
                else "made current again"
            )
            print(f"{scene}@{shared.revision}: {done if pushed.new else 'was there already'}", flush=True)
    if scenes:
        write_readme(place)
    listed = write_catalog(place) if arguments.catalog else None
    if arguments.json:
        print(json.dumps({"place": place.url, "scenes": rows, "catalog": listed}, indent=2))
    elif listed is not None:
        print(f"catalog.json: {listed} scenes")
    return 0


def run_pull(arguments: argparse.Namespace) -> int:
    """Pull or list scenes; go on with the others where one fails, and fail at the end."""
    from registry.exchange import open_place, pull_scene

    place = open_place(arguments.place)
    if arguments.list:
        return _list(place, arguments)
    wanted = _wanted(place, arguments)
    if arguments.name is not None and len(wanted) > 1:
        raise UsageError(f"--as names one scene, {len(wanted)} are to be pulled; pull them one by one")
    registry = open_registry(arguments.registry)
    rows: list[dict] = []
    failed: list[SimReconError] = []
    for name in wanted:
        try:
            added = pull_scene(place, name, registry, scene_id=arguments.name, replace=arguments.replace)
        except SimReconError as error:
            if len(wanted) == 1:
                raise
            failed.append(error)
            print(f"{name}: {error}", file=sys.stderr)
            continue
        rows.append(_added_json(added))
        if not arguments.json:
            _print_added(added)
    if arguments.json:
        print(json.dumps({"scenes": rows, "failed": [str(error) for error in failed]}, indent=2))
    if failed:
        print(f"{len(failed)} of {len(wanted)} scenes were not pulled", file=sys.stderr)
    return failed[0].exit_code if failed else 0


def _wanted(place: "Place", arguments: argparse.Namespace) -> list[str]:
    from registry.exchange import list_place
    from registry.exchange.sharing import current

    if bool(arguments.scenes) == arguments.all:
        raise UsageError(
            f"name SCENEs, or pass --all; `simrecon pull {place.url} --list` shows what there is"
        )
    wanted: list[str] = []
    for name in ["*"] if arguments.all else arguments.scenes:
        if not any(sign in name for sign in "*?["):
            wanted.append(name)
            continue
        found = [f"{shared.scene_id}@{shared.revision}" for shared in list_place(place, name)]
        if not found:
            current(place, name)  # raises with what there is
        wanted += found
    return list(dict.fromkeys(wanted))


def _list(place: "Place", arguments: argparse.Namespace) -> int:
    from registry.exchange import list_place
    from registry.exchange.sharing import read_entry

    found: dict[str, SharedScene] = {}
    for pattern in arguments.scenes or ["*"]:
        found |= {shared.scene_id: shared for shared in list_place(place, pattern)}
    entries = {}
    if len(found) <= _LISTED_WITH_DETAILS:
        entries = {name: read_entry(place, shared) for name, shared in found.items()}
    if arguments.json:
        rows = [
            {**entries.get(s.scene_id, {}), "scene": s.scene_id, "revision": s.revision, "pushed": s.pushed}
            for s in found.values()
        ]
        print(json.dumps(rows, indent=2))
        return 0
    width = max(map(len, found), default=0)
    for name, shared in found.items():
        p = shared.pushed
        when = f"{p[:4]}-{p[4:6]}-{p[6:8]} {p[9:11]}:{p[11:13]}"
        print(f"{name:<{width}}  {shared.revision}  {when}{_details(entries.get(name))}")
    if not found:
        print(f"no scenes in {place.url}; push one with: simrecon push SCENE {place.url}")
    return 0


def _details(entry: dict | None) -> str:
    """Return what an entry says of a scene; foreign texts without control characters."""
    from registry.exchange.card import printable

    if not entry:
        return ""
    size = entry.get("bytes")
    shown = f"  {size / 1e6:.1f} MB" if isinstance(size, int) else ""
    return f"  {printable(str(entry.get('objects')))[:8]} objects{shown}  {printable(str(entry.get('licence')))[:40]}"


def _added_json(added: "AddedScene") -> dict:
    record = added.record
    return {
        "scene": record.scene_id,
        "env_id": added.env_id,
        "revision": record.revision,
        "new": added.new,
        "licence": added.licence,
        "path": str(record.path),
    }


def _print_added(added: "AddedScene") -> None:
    record = added.record
    what = (
        f"revision {record.revision}, {record.n_objects} objects, {record.status}, licence: {added.licence}"
    )
    print(f"{'added' if added.new else 'was there already:'} {added.env_id}: {what}", flush=True)
