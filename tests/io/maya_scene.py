"""A parser of the subset of MEL that Maya ASCII files are made of, and the face that its nodes show."""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

_TOKEN = re.compile(r'\s*(?://[^\n]*|"((?:[^"\\]|\\.)*)"|([{};,])|([^\s"{};,]+))', re.S)
_ESCAPES = {"n": "\n", "r": "\r", "t": "\t"}
Word = tuple[str, str]
"""A token: its kind, ``text``, ``sign`` or ``word``, and what it says."""


def statements(text: str) -> list[list[Word]]:
    """Commands with their words; fails on what is none."""
    found: list[list[Word]] = [[]]
    at = 0
    text = text.rstrip()
    while at < len(text):
        match = _TOKEN.match(text, at)
        assert match, f"no MEL at {text[at : at + 40]!r}"
        at = match.end()
        quoted, sign, word = match.groups()
        if quoted is not None:
            plain = re.sub(r"\\(.)", lambda escape: _ESCAPES.get(escape[1], escape[1]), quoted)
            assert "\n" not in quoted
            found[-1].append(("text", plain))
        elif sign == ";":
            found.append([])
        elif sign or word:
            found[-1].append(("sign", sign) if sign else ("word", word))
    assert not found.pop(), "the last command has no end"
    return found


@dataclass
class Node:
    """A node of the scene: its kind and parent, its attributes by the names in the file, those that were added."""

    kind: str
    parent: str | None = None
    values: dict[str, list[str]] = field(default_factory=dict)
    added: set[str] = field(default_factory=set)


@dataclass
class MayaScene:
    """The nodes and connections of a file, and its rate."""

    nodes: dict[str, Node] = field(default_factory=dict)
    links: dict[str, str] = field(default_factory=dict)  # what drives an attribute
    rate: str = ""
    unit: str = ""

    @classmethod
    def read(cls, path: Path) -> "MayaScene":
        text = path.read_text(encoding="utf-8")
        assert text.startswith("//Maya ASCII ")
        scene, node = cls(), Node("")
        for (kind, command), *words in statements(text):
            assert kind == "word"
            values = [value for _, value in words]
            if command == "createNode":
                kind, flags = values[0], dict(zip(values[1::2], values[2::2], strict=True))
                assert set(flags) <= {"-n", "-p"}
                assert flags["-n"] not in scene.nodes, f"two nodes {flags['-n']}"
                assert re.fullmatch("[A-Za-z_][A-Za-z0-9_]*", flags["-n"])
                assert flags.get("-p") in {None, *scene.nodes}
                node = scene.nodes[flags["-n"]] = Node(kind, flags.get("-p"))
            elif command == "setAttr":
                scene._set(node, words)
            elif command == "addAttr":
                flags = dict(zip(values[::2], values[1::2], strict=True))
                assert set(flags) <= {"-ci", "-h", "-sn", "-ln", "-dt"}
                node.added.add(f".{flags['-sn']}")
            elif command == "connectAttr":
                source, target, *flags = values
                assert flags in ([], ["-na"])
                for end in (source, target):
                    assert end.split(".")[0] in {*scene.nodes, ":initialShadingGroup"}, end
                assert target not in scene.links or flags, f"{target} is driven twice"
                scene.links[target + (source if flags else "")] = source
            elif command == "currentUnit":
                scene.unit, scene.rate = values[values.index("-l") + 1], values[values.index("-t") + 1]
            else:
                assert command in ("requires", "fileInfo"), command
        return scene

    @staticmethod
    def _set(node: Node, words: list[Word]) -> None:
        values = [value for _, value in words]
        count, kind = None, None
        while values[0].startswith("-"):
            flag, value, *values = values
            assert flag in ("-s", "-ch", "-k")
            count = int(value) if flag == "-s" else count
        name, *values = values
        if values[:1] == ["-type"]:
            kind, values = values[1], values[2:]
        assert name.startswith(".")
        if kind in ("attributeAlias",):
            assert name in node.added
        if kind in ("pointArray", "componentList"):
            each = 4 if kind == "pointArray" else 1
            assert len(values) == 1 + each * int(values[0]), name
        span = re.fullmatch(r"(.*)\[(\d+)(?::(\d+))?\]", name)
        if span is None:
            assert name not in node.values
            node.values[name] = values
            return
        base, low, high = span[1], int(span[2]), int(span[3] or span[2])
        assert span[3] is None or high > low
        assert high < count
        node.values.setdefault(base, [])
        node.values.setdefault(f"{base}#", ["0"])
        assert int(node.values[f"{base}#"][0]) == low, "rows follow each other"
        node.values[f"{base}#"] = [str(high + 1)]
        if kind != "polyFaces":
            assert len(values) % (high - low + 1) == 0
        node.values[base] += values

    def of_kind(self, kind: str) -> dict[str, Node]:
        return {name: node for name, node in self.nodes.items() if node.kind == kind}

    def mesh(self) -> tuple[np.ndarray, list[list[int]], list[list[int]], np.ndarray]:
        """Points in centimetres, polygons, polygons of texture coordinates, texture coordinates."""
        node = self.nodes["faceShapeOrig"]
        points = np.array(node.values[".vt"], float).reshape(-1, 3)
        edges = np.array(node.values[".ed"], int).reshape(-1, 3)
        assert len(np.unique(np.sort(edges[:, :2], 1), axis=0)) == len(edges)
        words, polygons, uv_polygons = iter(node.values[".fc"]), [], []
        for word in words:
            if word == "f":
                ends = []
                for _ in range(int(next(words))):
                    edge = int(next(words))
                    a, b, _ = edges[edge] if edge >= 0 else edges[-edge - 1]
                    ends.append((int(a), int(b)) if edge >= 0 else (int(b), int(a)))
                assert all(one[1] == other[0] for one, other in zip(ends, [*ends[1:], ends[0]], strict=True))
                polygons.append([one for one, _ in ends])
            else:
                assert (word, next(words)) == ("mu", "0")
                uv_polygons.append([int(next(words)) for _ in range(int(next(words)))])
        uvs = np.array(node.values.get(".uvst[0].uvsp", []), float).reshape(-1, 2)
        return points, polygons, uv_polygons, uvs

    def aliases(self) -> list[str]:
        """Of the targets, by their number."""
        words = [word for word in self.nodes["shapes"].values[".aal"] if word not in "{},"]
        found = dict(zip(words[1::2], words[::2], strict=True))
        return [found[f"weight[{place}]"] for place in range(len(found))]

    def weight(self, place: int, given: Callable[[int], float], frame: float | None) -> float:
        """Of a target: what is connected to it, else what is given."""
        source = self.links.get(f"shapes.w[{place}]")
        if source is None:
            return given(place)
        node = self.nodes[source.split(".")[0]]
        if node.kind == "animCurveTU":
            assert node.values[".tan"] == ["2"]  # linear
            times, values = np.array(node.values[".ktv"], float).reshape(-1, 2).T
            return given(place) if frame is None else float(np.interp(frame, times, values))
        assert node.kind == "combinationShape"
        assert node.values[".combinationMethod"] == ["0"]  # the product
        name, product, number = source.split(".")[0], 1.0, 0
        while (driver := self.links.get(f"{name}.inputWeight[{number}]")) is not None:
            product *= self.weight(int(driver.removeprefix("shapes.w[")[:-1]), given, frame)
            number += 1
        assert number > 1
        return product

    def face(self, given: Callable[[int], float] = lambda place: 0.0, frame: float | None = None) -> np.ndarray:
        """Points in centimetres: each target's items joined by straight lines from the rest."""
        assert self.links["faceShape.i"] == "shapes.og[0]"
        assert self.links["shapes.ip[0].ig"] == "shapesGroupParts.og"
        assert self.links["shapesGroupParts.ig"] == "faceShapeOrig.w"
        points = self.mesh()[0]
        moved = points.copy()
        node = self.nodes["shapes"]
        for place in range(len(self.aliases())):
            at = [0.0]
            samples = [np.zeros_like(points)]
            numbers = [re.fullmatch(rf"\.it\[0\]\.itg\[{place}\]\.iti\[(\d+)\]\.ipt", name) for name in node.values]
            for number in sorted(int(match[1]) for match in numbers if match):
                where = f".it[0].itg[{place}].iti[{number}]"
                offsets = np.array(node.values[f"{where}.ipt"][1:], float).reshape(-1, 4)
                rows = []
                for span in node.values[f"{where}.ict"][1:]:
                    low, _, high = re.fullmatch(r"vtx\[(\d+)(:(\d+))?\]", span).groups()
                    rows += range(int(low), int(high or low) + 1)
                sample = np.zeros_like(points)
                sample[rows] = offsets[:, :3]
                at.append((number - 5000) / 1000)
                samples.append(sample)
            weight = self.weight(place, given, frame)
            right = int(np.clip(np.searchsorted(at, weight), 1, len(at) - 1))
            share = (weight - at[right - 1]) / (at[right] - at[right - 1])
            moved += (1 - share) * samples[right - 1] + share * samples[right]
        return moved
