# pyright: strict, reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
"""Check an untrusted .glb: a self-contained set of triangle meshes with finite numbers and bounded size.

Accepted is the part of glTF 2.0 that has one meaning for every reader: one scene, a forest of nodes, triangles,
accessors within the binary chunk, PNG and JPEG textures within it. Refused are URIs of any kind, extensions, sparse
accessors, skins, animations, morph targets, nodes with two parents, and everything else that glTF has.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, cast

import numpy as np

from registry.errors import BundleError
from registry.glb import read_glb
from registry.pictures import check_png_data, picture_size

MAX_VERTICES, MAX_INDICES = 5_000_000, 20_000_000  # as drawn: each time a node uses a mesh counts
MAX_COORDINATE = 1e6  # of a vertex and of a node's transform
MAX_NODE_DEPTH = 64
_MOST = {
    "scenes": 1, "nodes": 1000, "meshes": 1000, "materials": 1000, "textures": 256, "images": 64, "samplers": 256,
    "accessors": 5000, "bufferViews": 5000, "buffers": 1,
}  # fmt: skip
_TOP = frozenset((*_MOST, "asset", "scene", "extras"))
_NODE = frozenset(("mesh", "children", "name", "extras", "matrix", "translation", "rotation", "scale"))
_PRIMITIVE = frozenset(("attributes", "indices", "material", "mode", "extras"))
_MATERIAL = frozenset(
    ("name", "extras", "pbrMetallicRoughness", "normalTexture", "occlusionTexture", "emissiveTexture",
     "emissiveFactor", "alphaMode", "alphaCutoff", "doubleSided")
)  # fmt: skip
_PBR = frozenset(
    ("extras", "baseColorFactor", "baseColorTexture", "metallicFactor", "roughnessFactor", "metallicRoughnessTexture")
)  # fmt: skip
_TRANSFORM = {"matrix": 16, "translation": 3, "rotation": 4, "scale": 3}
_ATTRIBUTE = re.compile(r"POSITION|NORMAL|TANGENT|(TEXCOORD|COLOR)_[0-7]")
_DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_MIME = {"image/png": "png", "image/jpeg": "jpeg"}


@dataclass(frozen=True)
class MeshSize:
    """Size of a mesh file as it is drawn."""

    vertices: int = 0
    indices: int = 0
    pixels: int = 0  # of all textures


def check_glb(path: Path, name: str, decompress: bool = False) -> MeshSize:
    """Check a .glb file and return its size; with `decompress`, also the compressed data of its PNG textures.

    Raises:
        BundleError: It is none of the accepted kind; names the place and the value.
        OSError: It cannot be read.
    """
    document, binary = read_glb(path, name)
    return _Checked(document, binary, name, decompress).size()


class _Checked:
    """One document that is being checked; `fail` raises with its name."""

    def __init__(self, document: dict[str, Any], binary: memoryview, name: str, decompress: bool) -> None:
        self.name, self.decompress = name, decompress
        self.document = document
        self.binary = binary
        self.lists = {key: self._list(key) for key in _MOST}
        self.arrays: dict[int, np.ndarray] = {}
        self.views: list[memoryview] = []

    def fail(self, place: str, message: str) -> NoReturn:
        raise BundleError(f"{self.name}: {place}: {message}")

    def size(self) -> MeshSize:
        """Check everything; return the size."""
        extra = self.document.keys() - _TOP
        if extra:
            self.fail(ascii(min(extra))[:60], "not allowed in a bundle's mesh")
        asset = self.document.get("asset")
        if not isinstance(asset, dict) or cast("dict[str, Any]", asset).get("version") != "2.0":
            self.fail("asset", 'expected the version "2.0"')
        self._buffers()
        pixels = sum(self._image(i, item) for i, item in enumerate(self.lists["images"]))
        for i, item in enumerate(self.lists["textures"]):
            self._keys(f"textures[{i}]", item, frozenset(("source", "sampler", "name", "extras")))
            self._index(f"textures[{i}].source", item.get("source"), "images")
            if "sampler" in item:
                self._index(f"textures[{i}].sampler", item["sampler"], "samplers")
        for i, item in enumerate(self.lists["materials"]):
            self._material(f"materials[{i}]", item)
        sizes = [self._mesh(f"meshes[{i}]", item) for i, item in enumerate(self.lists["meshes"])]
        drawn = [sizes[mesh] for mesh in self._drawn_meshes()]
        vertices, indices = sum(v for v, _ in drawn), sum(i for _, i in drawn)
        if not drawn:
            self.fail("scene", "it has no mesh")
        if vertices > MAX_VERTICES or indices > MAX_INDICES:
            self.fail(
                "meshes",
                f"{vertices} vertices and {indices} indices, more than {MAX_VERTICES} and {MAX_INDICES}",
            )
        return MeshSize(vertices, indices, pixels)

    # ---- Values.

    def _list(self, key: str) -> list[dict[str, Any]]:
        items = self.document.get(key, [])
        if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
            self.fail(key, "expected a list of objects")
        if len(items) > _MOST[key]:
            self.fail(key, f"{len(items)} entries, more than {_MOST[key]}")
        return cast("list[dict[str, Any]]", items)

    def _keys(self, place: str, value: Any, allowed: frozenset[str]) -> dict[str, Any]:
        if not isinstance(value, dict):
            self.fail(place, "expected an object")
        found = cast("dict[str, Any]", value)
        extra = found.keys() - allowed
        if extra:
            self.fail(place, f"{ascii(min(extra))[:60]} is not allowed in a bundle's mesh")
        return found

    def _whole(self, place: str, value: Any, low: int, high: int) -> int:
        if type(value) is not int or not low <= value <= high:
            self.fail(place, f"expected a whole number from {low} to {high}, got {ascii(value)[:60]}")
        return value

    def _index(self, place: str, value: Any, kind: str) -> int:
        if not self.lists[kind]:
            self.fail(place, f"there are no {kind}")
        return self._whole(place, value, 0, len(self.lists[kind]) - 1)

    def _numbers(self, place: str, value: Any, count: int) -> None:
        values = cast("list[Any]", value) if isinstance(value, list) else []
        if len(values) != count or not all(
            type(x) in (int, float) and abs(x) <= MAX_COORDINATE for x in values
        ):
            self.fail(place, f"expected {count} numbers within {MAX_COORDINATE:g}, got {ascii(value)[:60]}")

    # ---- Binary data.

    def _buffers(self) -> None:
        for group in ("buffers", "images"):
            for i, item in enumerate(self.lists[group]):
                if "uri" in item:
                    self.fail(
                        f"{group}[{i}].uri",
                        f"it names another file, or holds data ({ascii(item['uri'])[:60]})",
                    )
        length = 0
        for item in self.lists["buffers"]:
            length = self._whole("buffers[0].byteLength", item.get("byteLength"), 1, len(self.binary))
        if len(self.binary) - length > 3:
            self.fail("buffers", f"the binary chunk has {len(self.binary)} bytes, {length} are used")
        for i, item in enumerate(self.lists["bufferViews"]):
            place = f"bufferViews[{i}]"
            self._index(f"{place}.buffer", item.get("buffer"), "buffers")
            start = self._whole(f"{place}.byteOffset", item.get("byteOffset", 0), 0, length)
            count = self._whole(f"{place}.byteLength", item.get("byteLength"), 1, length - start)
            if "byteStride" in item and self._whole(f"{place}.byteStride", item["byteStride"], 4, 252) % 4:
                self.fail(f"{place}.byteStride", "expected a multiple of 4")
            self.views.append(self.binary[start : start + count])

    def _image(self, i: int, item: dict[str, Any]) -> int:
        place = f"images[{i}]"
        self._keys(place, item, frozenset(("bufferView", "mimeType", "name", "extras")))
        view = self.views[self._index(f"{place}.bufferView", item.get("bufferView"), "bufferViews")]
        kind = _MIME.get(str(item.get("mimeType")))
        if kind is None:
            self.fail(
                f"{place}.mimeType",
                f"expected image/png or image/jpeg, got {ascii(item.get('mimeType'))[:60]}",
            )
        width, height = picture_size(view, f"{self.name}: {place}", kind)
        if self.decompress and kind == "png":
            check_png_data(view, f"{self.name}: {place}")
        return width * height

    def _array(self, number: int) -> np.ndarray:
        """Return the values (count, width) of an accessor as a view of the binary chunk."""
        if number in self.arrays:
            return self.arrays[number]
        item, place = self.lists["accessors"][number], f"accessors[{number}]"
        self._keys(
            place, item,
            frozenset(("bufferView", "byteOffset", "componentType", "normalized", "count", "type", "min", "max", "name",
                       "extras")),
        )  # fmt: skip
        view_number = self._index(f"{place}.bufferView", item.get("bufferView"), "bufferViews")
        view, dtype = self.views[view_number], _DTYPES.get(cast(Any, item.get("componentType")))
        width = _WIDTHS.get(str(item.get("type")))
        if type(item.get("componentType")) is not int or dtype is None or width is None:
            self.fail(place, "expected a component type and a type of glTF (no matrix)")
        count = self._whole(f"{place}.count", item.get("count"), 1, MAX_INDICES)
        start = self._whole(f"{place}.byteOffset", item.get("byteOffset", 0), 0, len(view))
        bytes_each = np.dtype(dtype).itemsize * width
        stride = self.lists["bufferViews"][view_number].get("byteStride", bytes_each)
        outside = start + (count - 1) * stride + bytes_each > len(view)
        if outside or stride < bytes_each or start % np.dtype(dtype).itemsize:
            self.fail(
                place, f"{count} values of {bytes_each} bytes do not fit its buffer view of {len(view)}"
            )
        for key in ("min", "max"):
            if key in item:
                self._limits(f"{place}.{key}", item[key], width)
        flat = np.ndarray((count, width), dtype, view, start, (stride, np.dtype(dtype).itemsize))
        self.arrays[number] = flat
        return flat

    def _limits(self, place: str, value: Any, width: int) -> None:
        values = cast("list[Any]", value) if isinstance(value, list) else []
        if len(values) != width or not all(type(x) in (int, float) for x in values):
            self.fail(place, f"expected {width} numbers")

    # ---- Meshes, materials, nodes.

    def _mesh(self, place: str, item: dict[str, Any]) -> tuple[int, int]:
        """Return the numbers of vertices and indices."""
        self._keys(place, item, frozenset(("primitives", "name", "extras")))
        primitives = item.get("primitives")
        if not isinstance(primitives, list) or not 1 <= len(cast("list[Any]", primitives)) <= _MOST["meshes"]:
            self.fail(f"{place}.primitives", f"expected a list of 1 to {_MOST['meshes']}")
        sizes = [
            self._primitive(f"{place}.primitives[{k}]", p)
            for k, p in enumerate(cast("list[Any]", primitives))
        ]
        return sum(v for v, _ in sizes), sum(i for _, i in sizes)

    def _primitive(self, place: str, value: Any) -> tuple[int, int]:
        item = self._keys(place, value, _PRIMITIVE)
        self._whole(f"{place}.mode", item.get("mode", 4), 4, 4)
        if "material" in item:
            self._index(f"{place}.material", item["material"], "materials")
        attributes = item.get("attributes")
        if not isinstance(attributes, dict) or "POSITION" not in attributes:
            self.fail(f"{place}.attributes", "expected a POSITION")
        vertices = 0
        for key, number in cast("dict[str, Any]", attributes).items():
            where = f"{place}.attributes.{key if _ATTRIBUTE.fullmatch(key) else '?'}"
            if not _ATTRIBUTE.fullmatch(key):
                self.fail(where, f"{ascii(key)[:60]} is not allowed in a bundle's mesh")
            fresh = number not in self.arrays if isinstance(number, int) else True
            array = self._array(self._index(where, number, "accessors"))
            vertices = vertices or len(array)
            if len(array) != vertices:
                self.fail(where, f"{len(array)} values for {vertices} vertices")
            if fresh and array.dtype.kind == "f":
                self._finite(where, array)
            if key in ("POSITION", "NORMAL") and (array.dtype != np.float32 or array.shape[1] != 3):
                self.fail(where, "expected three 32-bit floats a vertex")
        if "indices" not in item:
            if vertices % 3:
                self.fail(place, f"{vertices} vertices are no whole number of triangles")
            return vertices, vertices
        array = self._array(self._index(f"{place}.indices", item["indices"], "accessors"))
        if array.dtype.kind != "u" or array.shape[1] != 1 or len(array) % 3:
            self.fail(f"{place}.indices", "expected three unsigned whole numbers a triangle")
        largest = int(array.max())
        if largest >= vertices:
            self.fail(f"{place}.indices", f"index {largest} of {vertices} vertices")
        return vertices, len(array)

    def _finite(self, place: str, array: np.ndarray) -> None:
        low, high = float(array.min()), float(array.max())  # NaN if any value is NaN
        if not (low >= -MAX_COORDINATE and high <= MAX_COORDINATE):
            self.fail(place, f"expected finite numbers within {MAX_COORDINATE:g}, got {low:g} to {high:g}")

    def _material(self, place: str, value: dict[str, Any]) -> None:
        item = self._keys(place, value, _MATERIAL)
        pbr = self._keys(f"{place}.pbrMetallicRoughness", item.get("pbrMetallicRoughness", {}), _PBR)
        for key, entry in (*item.items(), *pbr.items()):
            where = f"{place}.{key}"
            if key.endswith("Texture"):
                allowed = frozenset(("index", "texCoord", "scale", "strength", "extras"))
                texture = self._keys(where, entry, allowed)
                self._index(f"{where}.index", texture.get("index"), "textures")
                self._whole(f"{where}.texCoord", texture.get("texCoord", 0), 0, 7)
            elif key in ("baseColorFactor", "emissiveFactor"):
                self._numbers(where, entry, 4 if key == "baseColorFactor" else 3)
            elif key in ("metallicFactor", "roughnessFactor", "alphaCutoff") and type(entry) not in (
                int,
                float,
            ):
                self.fail(where, "expected a number")
            elif key == "alphaMode" and entry not in ("OPAQUE", "MASK", "BLEND"):
                self.fail(where, "expected OPAQUE, MASK or BLEND")

    def _drawn_meshes(self) -> list[int]:
        """Return the mesh of every node below the scene; every node has at most one parent."""
        if len(self.lists["scenes"]) != 1:
            self.fail("scenes", "expected one scene")
        self._whole("scene", self.document.get("scene", 0), 0, 0)
        scene = self._keys("scenes[0]", self.lists["scenes"][0], frozenset(("nodes", "name", "extras")))
        seen: set[int] = set()
        pending = [(number, 1) for number in self._children("scenes[0].nodes", scene.get("nodes"), seen)]
        drawn: list[int] = []
        while pending:
            number, depth = pending.pop()
            place, node = f"nodes[{number}]", self.lists["nodes"][number]
            self._keys(place, node, _NODE)
            if depth > MAX_NODE_DEPTH:
                self.fail(place, f"nested more than {MAX_NODE_DEPTH} deep")
            for key, count in _TRANSFORM.items():
                if key in node:
                    self._numbers(f"{place}.{key}", node[key], count)
            if "mesh" in node:
                drawn.append(self._index(f"{place}.mesh", node["mesh"], "meshes"))
            if "children" in node:
                below = self._children(f"{place}.children", node["children"], seen)
                pending += [(child, depth + 1) for child in below]
        if len(seen) != len(self.lists["nodes"]):
            self.fail("nodes", "expected every node once below the scene")
        return drawn

    def _children(self, place: str, value: Any, seen: set[int]) -> list[int]:
        items = cast("list[Any]", value) if isinstance(value, list) else []
        if not items:
            self.fail(place, "expected a list of nodes")
        for item in items:
            number = self._index(place, item, "nodes")
            if number in seen:
                self.fail(place, f"node {number} is used twice")
            seen.add(number)
        return cast("list[int]", items)
