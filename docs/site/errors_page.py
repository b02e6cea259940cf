"""The page of all errors: each code with its sentences, as they stand in the source."""

import ast
import functools
import re
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2] / "stcal"
CODE = re.compile(r"E(-[A-Z]+)+")
HEAD = """# Errors

Every error is one line on standard error: what is wrong, where, what was measured, what is needed, and what to do. The
exit code is 2 where an input is at fault, 3 where a computation could not deliver, 4 where a result failed its checks.

Each error also has a code, which stays when its sentence is reworded. `--debug` prints it behind the traceback, and
`--json -` writes `{"error": …, "code": …}`. In Python it is `StcalError.code`. Below, `{…}` stands for what the message
fills in.
"""


def sentence(node: ast.expr) -> str:
    """The text of a message, with `{…}` for what is filled in."""
    match node:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=values):
            return "".join(sentence(value) for value in values)
        case ast.FormattedValue(value=value):
            return sentence(value)
        case ast.BinOp(left=left, op=ast.Add(), right=right) if isinstance(left, ast.JoinedStr):
            return sentence(left) + sentence(right)
        case ast.IfExp(body=one, orelse=other):
            return f"{sentence(one)} / {sentence(other)}"
        case ast.Name(id=name) | ast.Attribute(attr=name) | ast.Call(func=ast.Name(id=name)):
            return f"{{{name}}}"
    return "{…}"


LINES_ABOVE = 8
"""Largest distance of a text that is given a name from the error whose sentence holds it."""


class _Texts(ast.NodeTransformer):
    """Puts texts that are given a name just above, such as ``fault = f"…"``, in place of the name."""

    def __init__(self, nodes: list[ast.AST]):
        assigned = (node for node in nodes if isinstance(node, ast.Assign))
        texts = [node for node in assigned if isinstance(node.value, ast.JoinedStr | ast.Constant)]
        self.texts = [(node.lineno, ast.unparse(node.targets[0]), node.value) for node in texts]

    def visit_Name(self, node: ast.Name) -> ast.expr:
        near = [text for at, name, text in self.texts if name == node.id and 0 < node.lineno - at <= LINES_ABOVE]
        return self.visit(near[-1]) if near and isinstance(getattr(near[-1], "value", ""), str) else node


def errors_in(source: str) -> Iterator[tuple[str, str, str]]:
    """(class, code, sentence) of each error that a module makes: calls with a code and a text, in this order."""
    nodes = list(ast.walk(ast.parse(source)))
    texts = _Texts(nodes)
    for node in nodes:
        if isinstance(node, ast.Tuple):  # code, text = "E-…", f"…"
            node = ast.Call(ast.Name("InputError"), node.elts, [])
        if not isinstance(node, ast.Call):
            continue
        for code, text in zip(node.args, node.args[1:], strict=False):
            if isinstance(code, ast.Constant) and CODE.fullmatch(str(code.value)):
                yield ast.unparse(node.func), str(code.value), sentence(texts.visit(text))


@functools.cache
def all_errors() -> list[tuple[str, str, str]]:
    """:func:`errors_in` of all modules of the package."""
    sources = (path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py")))
    return [error for source in sources for error in errors_in(source)]


def page() -> str:
    """Returns the page."""
    sentences: dict[str, set[str]] = {}
    for _, code, text in all_errors():
        sentences.setdefault(code, set()).add(text)
    parts = [HEAD]
    for code, texts in sorted(sentences.items()):
        parts.append(f"\n## {code}\n\n" + "".join(f"- {_literal(text)}\n" for text in sorted(texts)))
    return "".join(parts)


def _literal(text: str) -> str:
    return f"`` {text} ``" if "`" in text else f"`{text}`"
