"""Defaults of options are those of the functions that the commands call; flags are off by default."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import gpuvision as gv
from gpuvision.cli.merge import merge
from gpuvision.cli.select import select
from gpuvision.cli.simulate import simulate
from gpuvision.matching.features.imaging import Imaging
from gpuvision.workflows import simulating
from gpuvision.workflows.merging import merge_scans
from source_trees import tree_of

COMMANDS = Path(__file__).resolve().parents[2] / "gpuvision" / "cli"
ON_BY_DEFAULT = {("simulate.py", "noise")}


def default_of(function: Callable[..., Any], name: str) -> Any:
    return inspect.signature(function).parameters[name].default


@pytest.mark.parametrize(
    ("command", "option", "function", "parameter"),
    [
        (merge, "max_sigmas", merge_scans, "max_sigmas"),
        (merge, "max_sigmas", gv.merge_height_maps, "max_sigmas"),
        (simulate, "patch_size", simulating.prepare_simulation, "patch_size"),
        (select, "missing", gv.choose_features, "missing"),
        (select, "blur", Imaging, "blur_px"),
        (select, "width", Imaging, "width_px"),
    ],
)
def test_an_option_has_the_default_of_its_parameter(
    command: Callable[..., Any], option: str, function: Callable[..., Any], parameter: str
) -> None:
    assert default_of(command, option) == default_of(function, parameter)


def _flags() -> Iterator[tuple[str, str, bool]]:
    """Yield the file, the name and the default of each parameter of a command whose default is True or False."""
    for path in sorted(COMMANDS.glob("*.py")):
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.arguments):
                places = [*node.posonlyargs, *node.args]
                pairs = [*zip(places[len(places) - len(node.defaults) :], node.defaults, strict=True)]
                pairs += [(name, value) for name, value in zip(node.kwonlyargs, node.kw_defaults, strict=True) if value]
                for name, value in pairs:
                    if isinstance(value, ast.Constant) and isinstance(value.value, bool):
                        yield path.name, name.arg, value.value


def test_flags_are_off_by_default() -> None:
    flags = list(_flags())
    assert len(flags) > 15
    assert {(file, name) for file, name, is_on in flags if is_on} == ON_BY_DEFAULT
