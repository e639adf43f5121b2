"""Rules that every source file keeps: flags of dataclasses, keyword-only parameters, equal lengths in zip.

A test of one operation does not see that a class lost its flag. These tests read the source and take a second.
"""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

from source_trees import tree_of

ROOT = Path(__file__).resolve().parents[1]
Node = TypeVar("Node", bound=ast.AST)
_KINDS = (ast.ClassDef, ast.Call, ast.arguments, ast.JoinedStr)

# Dataclasses whose members may be given by position: records that one module makes and reads, and pairs and triples
# of the host. All others are made by keyword: operations, options and results get new members between the old ones.
POSITIONAL_DATACLASSES = {
    *("ExchangedAxes", "PixelMap", "Packer", "SmoothResiduals", "PackedLines", "Evaluation", "Minimum", "FitState"),
    *("CorrelatedErrors", "_Task", "_Candidate", "TransformedAperture", "Shape", "DrawnObject", "_ModelProblem"),
    *("LightCut", "LightTree", "Bvh", "Defects", "Scene", "LitSegments", "ProjectedLines", "MirrorSurfaces", "Patches"),
    *("SheetIndex", "_Job", "Batch", "Site", "ListedDevice", "ProbedDevice", "Launch", "Trial", "Plan", "FileLimit"),
    *("DurationStatistics", "Step", "WorkSize", "Specs", "Stage", "Layout", "ConvexParts"),
}
# Dataclasses that are compared by identity. They hold arrays, whose comparison has no single truth value, or they are
# keys of caches, where a comparison of all members would be slow.
COMPARED_BY_IDENTITY = {
    *("PixelMap", "BoardView", "Aperture", "Pad", "Artwork", "Shape", "DrawnObject", "LocatedBoard", "FeatureSet"),
    *("DistanceMap", "LocatedRobot", "CoarseRegistration", "ClusteredIrradiance", "LightCut", "LightTree"),
    *("ErrorAttribution", "StripErrorModel", "LightPaths", "Bvh", "Scene", "CameraSimulator", "Mask", "PsdSimulator"),
    *("SensorView", "ViewRays", "DirectLight", "LitSegments", "LensVisibility", "ProjectedLines", "MirrorFacets"),
    *("MirrorPoints", "MirrorSurfaces", "Mirrors", "Patches", "Radiosity", "SheetIndex", "SpecularInterreflection"),
    *("SurfaceReflection", "SheetLighting", "SheetDivision", "SimulationTask", "Site", "ConvexParts"),
}
# Calls of zip that end with the shorter sequence, and why.
UNEQUAL_LENGTHS = {
    "gpuvision/matching/artwork/board_files.py": 1,  # the common beginning of two names
    "gpuvision/camera/image_map.py": 1,  # each table takes the first of the shifts
    "host/tiff_files.py": 1,  # a damaged TIFF states more strips than it counts
}
# Units of messages by the factor on a value in SI units, or on a fraction.
UNITS = {100: {"%"}, 1e3: {"mm", "ms", "mrad"}, 1e6: {"um", "µm", "us"}, 1e9: {"nm"}}
_UNIT = re.compile(r"%|(?<![\w])(?:mm|ms|mrad|um|µm|us|nm|m|s|rad|px|degrees)\b")


@functools.cache
def _all_nodes() -> dict[type[ast.AST], list[tuple[str, ast.AST]]]:
    """Return the file and the node of each node, by its kind."""
    found: dict[type[ast.AST], list[tuple[str, ast.AST]]] = {}
    for path in (each for folder in ("gpuvision", "host") for each in sorted((ROOT / folder).rglob("*.py"))):
        file = path.relative_to(ROOT).as_posix()
        for node in ast.walk(tree_of(path)):
            if isinstance(node, _KINDS):
                found.setdefault(type(node), []).append((file, node))
    return found


def _nodes(kind: type[Node]) -> Iterator[tuple[str, Node]]:
    """Yield the file and the node of each node of a kind."""
    for file, node in _all_nodes()[kind]:
        assert isinstance(node, kind)
        yield file, node


def _flags() -> Iterator[tuple[str, dict[str, bool]]]:
    """Yield the name and the flags of each dataclass."""
    for _, node in _nodes(ast.ClassDef):
        for each in node.decorator_list:
            if ast.unparse(each).partition("(")[0] == "dataclass":
                words = each.keywords if isinstance(each, ast.Call) else []
                yield node.name, {str(word.arg): ast.literal_eval(word.value) for word in words}


def test_dataclasses_are_made_by_keyword() -> None:
    classes = list(_flags())
    assert len(classes) > 150
    positional = {name for name, flags in classes if not flags.get("kw_only", False)}
    new = sorted(positional - POSITIONAL_DATACLASSES)
    assert not new, f"{new}: add kw_only=True, or the name to POSITIONAL_DATACLASSES"


def test_private_fields_are_not_printed() -> None:
    """They are computed from the parameters, and may be large arrays."""
    checked, printed = 0, []
    for file, node in _nodes(ast.ClassDef):
        for each in (each for each in node.body if isinstance(each, ast.AnnAssign)):
            if ast.unparse(each.target).startswith("_") and isinstance(each.value, ast.Call):
                checked += 1
                flags = {word.arg: ast.unparse(word.value) for word in each.value.keywords}
                if (flags.get("init"), flags.get("repr")) != ("False", "False"):
                    printed.append(f"{file}: {node.name}.{ast.unparse(each.target)}")
    assert checked > 10
    assert printed == []


def test_dataclasses_with_arrays_are_compared_by_identity() -> None:
    assert COMPARED_BY_IDENTITY - {name for name, flags in _flags() if not flags.get("eq", True)} == set()


def test_zip_needs_equal_lengths() -> None:
    """A sequence that is too short is a fault of the program; zip would drop the last members without a word."""
    found: dict[str, int] = {}
    calls = 0
    for file, node in _nodes(ast.Call):
        if ast.unparse(node.func) == "zip":
            calls += 1
            if {word.arg: ast.unparse(word.value) for word in node.keywords} != {"strict": "True"}:
                found[file] = found.get(file, 0) + 1
    assert calls > 100
    assert found == UNEQUAL_LENGTHS


def test_nothing_is_overwritten_by_default() -> None:
    """The default of each parameter and member `overwrite` is False."""
    defaults = []
    for file, node in _nodes(ast.arguments):
        places = [*node.posonlyargs, *node.args]
        pairs = [*zip(places[len(places) - len(node.defaults) :], node.defaults, strict=True)]
        pairs += [(name, value) for name, value in zip(node.kwonlyargs, node.kw_defaults, strict=True) if value]
        defaults += [(file, ast.unparse(value)) for name, value in pairs if name.arg == "overwrite"]
    assert len(defaults) > 30
    assert [each for each in defaults if each[1] != "False"] == []


def test_options_are_given_by_keyword() -> None:
    """After positional-only parameters come no parameters that are positional, too, but ``**values`` or options."""
    signatures = list(_nodes(ast.arguments))
    assert [(file, ast.unparse(node)) for file, node in signatures if node.posonlyargs and node.args] == []
    assert [(file, ast.unparse(node)) for file, node in signatures if node.posonlyargs and node.defaults] == []


def _scaled_values() -> Iterator[tuple[str, ast.expr, str]]:
    """Yield the file, the expression and the following text of each value of a message that a large number scales."""
    for file, node in _nodes(ast.JoinedStr):
        for number, part in enumerate(node.values):
            if isinstance(part, ast.FormattedValue):
                terms = [each for each in ast.walk(part.value) if isinstance(each, ast.BinOp)]
                factors = [each for term in terms for each in (term.left, term.right) if isinstance(each, ast.Constant)]
                if any(isinstance(each.value, int | float) and abs(each.value) > 50 for each in factors):
                    texts = [each.value for each in node.values[number + 1 :] if isinstance(each, ast.Constant)]
                    yield f"{file}:{node.lineno}", part.value, "".join(texts)


def test_a_factor_in_a_message_belongs_to_its_unit() -> None:
    """100 stands before %, 1e3 before mm, ms or mrad, 1e6 before um or us; nothing but a product has such a number."""
    wrong, count = [], 0
    for place, value, text in _scaled_values():
        products = [each for each in ast.walk(value) if isinstance(each, ast.BinOp) and isinstance(each.op, ast.Mult)]
        factors = [each for product in products for each in (product.left, product.right)]
        factor = next((each.value for each in factors if isinstance(each, ast.Constant) and each.value in UNITS), None)
        unit = _UNIT.search(text)
        count += 1
        # Text for other programs, such as G-code, has no units.
        if factor is None or (unit is not None and unit[0] not in UNITS[factor]):
            wrong.append(f"{place}: {ast.unparse(value)} before {unit[0] if unit else None!r}")
    assert count > 60
    assert wrong == []
