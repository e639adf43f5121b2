"""Number of floating-point operations of a Python function, counted while it runs.

The source of the function is rewritten: each addition, subtraction, multiplication and division is a call that adds
the number of elements of a floating-point result; a power, a root, an exponential and the like count 1. Operations on
integers and on constants, comparisons, negations, absolute values and conversions count nothing. Functions that the
function calls are rewritten too: of Numba, and of this package.
"""

from __future__ import annotations

import ast
import inspect
import itertools
import math
import operator
import textwrap
from collections.abc import Callable
from typing import Any

import numba
import numpy as np

_OPERATORS: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_FUNCTIONS = {
    getattr(module, name)
    for module in (np, math)
    for name in ("sqrt", "exp", "log", "sin", "cos", "arctan2", "atan2", "erf", "erfc", "hypot")
    if hasattr(module, name)
}
_SUMS = {np.sum, np.mean}  # an operation for each element; also as methods
_REWRITTEN = "<counted>"  # file of rewritten functions


class _Rewriter(ast.NodeTransformer):
    """Replace operators and calls by calls of the counter."""

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        if type(node.op) not in _OPERATORS or not any(_is_computed(each) for each in (node.left, node.right)):
            return node
        self.generic_visit(node)
        return _call("__operate", ast.Constant(type(node.op).__name__), node.left, node.right)

    def visit_AugAssign(self, node: ast.AugAssign) -> ast.AST:
        if type(node.op) not in _OPERATORS:
            return node
        target = ast.parse(ast.unparse(node.target), mode="eval").body
        value = ast.BinOp(target, node.op, node.value)
        return ast.Assign([self.visit(node.target)], self.visit(value))

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        return ast.Call(ast.Name("__run", ast.Load()), [node.func, *node.args], node.keywords)


def _call(name: str, *arguments: ast.expr) -> ast.Call:
    return ast.Call(ast.Name(name, ast.Load()), list(arguments), [])


def _is_computed(node: ast.expr) -> bool:
    """Return whether an expression is more than numbers and constants such as np.pi."""
    names = [each.id for each in ast.walk(node) if isinstance(each, ast.Name)]
    return any(name not in ("np", "math") for name in names)


class Counter:
    """Counter of the operations of functions that it runs.

    Attributes
    ----------
    count : int
        Operations of all runs.
    """

    def __init__(self) -> None:
        self.count = 0
        self._rewritten: dict[Any, Callable[..., Any]] = {}

    def run(self, function: Any, *arguments: Any, **options: Any) -> Any:
        """Run a function and count its operations; return its result."""
        if function in _FUNCTIONS:
            return self._add(function(*arguments, **options))
        if function in _SUMS:
            self._add(np.asarray(arguments[0]))
        if isinstance(getattr(function, "__self__", None), np.ndarray) and function.__name__ in ("sum", "mean"):
            self._add(function.__self__)
        if function is np.einsum:
            self._add_products(*arguments)
        if function is numba.prange:
            return range(*arguments)
        if function is numba.get_num_threads:
            return 1
        return self._counting(function)(*arguments, **options)

    def _counting(self, function: Callable[..., Any]) -> Callable[..., Any]:
        plain = getattr(function, "py_func", function)
        is_own = inspect.isfunction(plain) and plain.__module__.startswith("gpuvision.")
        if (not is_own and plain is function) or plain.__code__.co_filename == _REWRITTEN:
            return function
        if plain not in self._rewritten:
            tree = ast.parse(textwrap.dedent(inspect.getsource(plain)))
            definition = tree.body[0]
            assert isinstance(definition, ast.FunctionDef)
            definition.decorator_list = []
            definition.args.defaults, definition.args.kw_defaults = [], [None] * len(definition.args.kwonlyargs)
            definition.returns = None
            code = compile(ast.fix_missing_locations(_Rewriter().visit(tree)), _REWRITTEN, "exec")
            names = plain.__globals__ | inspect.getclosurevars(plain).nonlocals
            names |= {"__operate": self._operate, "__run": self.run}
            exec(code, names)
            made = names[plain.__name__]
            made.__defaults__, made.__kwdefaults__ = plain.__defaults__, plain.__kwdefaults__
            self._rewritten[plain] = made
        return self._rewritten[plain]

    def _operate(self, name: str, left: Any, right: Any) -> Any:
        return self._add(_OPERATORS[getattr(ast, name)](left, right))

    def _add_products(self, subscripts: str, *factors: Any) -> None:
        """Count the products and sums of np.einsum over all indices."""
        letters = subscripts.split("->")[0].split(",")
        pairs = [zip(each, array.shape, strict=True) for each, array in zip(letters, factors, strict=True)]
        sizes = dict(itertools.chain.from_iterable(pairs))
        self.count += len(factors) * math.prod(sizes.values())

    def _add(self, result: Any) -> Any:
        kind = getattr(result, "dtype", None)
        if isinstance(result, float) or (kind is not None and kind.kind == "f"):
            self.count += int(np.size(result))
        return result


def operations_of(function: Any, *arguments: Any) -> int:
    """Return the number of floating-point operations of a call."""
    counter = Counter()
    with np.errstate(all="ignore"):
        counter.run(function, *arguments)
    return counter.count
