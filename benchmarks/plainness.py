"""How plain the code and the docstrings of a package are, in numbers (`benchmarks.size`)."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterable, Iterator

FEWEST_PARAMETERS = {True: 3, False: 5}
"""Parameters from which a function, public or not, should have an `Args:` section."""

STILTED = re.compile(r"\b(?:of which|that of|those of|is no|are no|so many)\b")
"""Forms that are read twice."""

LAYOUT = (tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
"""Tokens that are no code; comments are neither."""

Function = ast.FunctionDef | ast.AsyncFunctionDef


def plainness(texts: Iterable[str]) -> dict[str, float]:
    """Counts over the source texts of Python files, by what is counted."""
    sources = list(texts)
    trees = [ast.parse(text) for text in sources]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    docstrings = list(_docstrings(nodes))
    code = [_code_tokens(text) for text in sources]
    tokens = sum(count for count, _ in code)
    lines = sum(lines for _, lines in code)
    functions = [node for node in nodes if isinstance(node, Function) and _should_have_args(node)]
    with_args = [node for node in functions if "Args:" in (ast.get_docstring(node) or "")]
    sentences = [
        sentence for text in docstrings for sentence in re.split(r"(?<=[.:])\s+", text) if sentence
    ]
    return {
        "statements": sum(isinstance(node, ast.stmt) for node in nodes) - len(docstrings),
        "tokens": tokens,
        "tokens a code line": round(tokens / lines, 1),
        "functions that should have `Args:`": len(functions),
        "of these, with `Args:`, per cent": round(100 * len(with_args) / max(1, len(functions))),
        "named lambdas": sum(_names_a_lambda(node) for node in nodes),
        "parallel assignments": sum(_is_parallel(node) for node in nodes),
        "stilted sentences of docstrings, per cent": round(
            100 * sum(bool(STILTED.search(text)) for text in sentences) / max(1, len(sentences)), 1
        ),
    }


def _docstrings(nodes: list[ast.AST]) -> Iterator[str]:
    """Texts that stand as statements: docstrings, also those below constants and fields."""
    for node in nodes:
        value = node.value if isinstance(node, ast.Expr) else None
        if isinstance(value, ast.Constant) and isinstance(value.value, str):
            yield value.value


def _code_tokens(text: str) -> tuple[int, int]:
    """Numbers of tokens, and of lines that have some, without comments and docstrings."""
    count = 0
    lines = set()
    starts_statement = True
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT or token.type in LAYOUT:
            starts_statement = starts_statement or token.type != tokenize.COMMENT
            continue
        is_docstring = starts_statement and token.type == tokenize.STRING
        starts_statement = False
        if not is_docstring:
            count += 1
            lines.update(range(token.start[0], token.end[0] + 1))
    return count, len(lines)


def _should_have_args(function: Function) -> bool:
    arguments = function.args
    names = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    parameters = [name for name in names if name.arg not in ("self", "cls")]
    is_public = not function.name.startswith("_")
    return len(parameters) >= FEWEST_PARAMETERS[is_public]


def _names_a_lambda(node: ast.AST) -> bool:
    return isinstance(node, ast.Assign | ast.AnnAssign) and isinstance(node.value, ast.Lambda)


def _is_parallel(node: ast.AST) -> bool:
    """Whether a statement assigns several values to several names."""
    return (
        isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Tuple)
        and isinstance(node.value, ast.Tuple)
    )
