"""The source files that a function is made of, found without importing any: the Makefile remakes what they make."""

import ast
from collections import defaultdict
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

from fiplib.reproduction.sources import Product

ROOT = Path(__file__).parents[2]
_READING = [f"fiplib/reproduction/{name}.py" for name in ("making", "sources", "stored")]  # of every product


def files(*addresses: str) -> list[Path]:
    """Return the files, relative to the repository, of functions ``module:name`` and of all that these refer to.

    Only what is referred to counts, at any depth: an edit of the simulator redraws no figure of a study, although the
    study's module imports it. It is the package's files that are searched, and nothing that is found by its name as
    text: ``pkgutil.resolve_name("fiplib...")``.
    """
    seen, waiting = set(), list(addresses)
    while waiting:
        if (address := waiting.pop()) not in seen:
            seen.add(address)
            waiting += _references(*address.split(":")[:2])  # a class with all its functions
    modules = map(_module, {address.partition(":")[0] for address in seen})
    return sorted(module.path for module in modules if module)


def rules(products: Mapping[str, Product]) -> list[str]:
    """Return the lines of a makefile that name the sources of each product: code and data."""
    common = [Path("requirements.lock"), Path("fiplib/products.py"), *map(Path, _READING)]
    lines, scanned = [], set(common)
    for name, product in products.items():
        reading = ["fiplib.bags:read"] if product.bags else []
        code = dict.fromkeys([*common, *files(product.address, *product.parts, *reading)])
        scanned.update(code)
        lines.append(f"sources_{name} := {' '.join(map(str, [*code, *product.files()]))}")
    sources = " ".join(sorted(map(str, scanned)))
    # a source without a rule would stop make once it is deleted; with an empty one, this file is made again
    return [*lines, f".make/products.mk: {sources}", f"{sources}:"]


class _Module(NamedTuple):
    """A source file: the top-level ``statements`` that define a name, those under "" run whatever is asked for;
    ``imported`` names, those in functions too, with their addresses ``module:name`` (``*``: the module itself)."""

    path: Path
    statements: dict[str, list[ast.stmt]]
    imported: dict[str, str]


@cache
def _module(name: str) -> _Module | None:
    path = ROOT.joinpath(*name.split("."))
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    if not name.startswith("fiplib") or not path.exists():
        return None
    tree = ast.parse(path.read_bytes())
    statements, imported = defaultdict(list), {}
    for node in _executed(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            for alias in node.names:
                whole = alias.name if isinstance(node, ast.Import) else f"{node.module}.{alias.name}"
                if whole.startswith("fiplib"):
                    address = f"{whole}:*" if _module(whole) else f"{node.module}:{alias.name}"
                    imported[alias.asname or alias.name] = address
    for statement in tree.body:
        if isinstance(statement, ast.FunctionDef | ast.ClassDef):
            statements[statement.name].append(statement)
        elif not isinstance(statement, ast.Import | ast.ImportFrom):
            names = [node for node in _executed(statement) if isinstance(node, ast.Name)]
            defined = {node.id for node in names if isinstance(node.ctx, ast.Store)}
            simple = isinstance(statement, ast.Assign | ast.AnnAssign) and defined
            for one in defined if simple else {"", *defined}:
                statements[one].append(statement)
    return _Module(path.relative_to(ROOT), statements, imported)


def _executed(tree: ast.AST) -> Iterator[ast.AST]:
    """A node and all below it, each before its children, but for what only a type checker reads."""
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
            yield node
            waiting += ast.iter_child_nodes(node)


@cache
def _references(name: str, member: str) -> set[str]:
    """Return the addresses that a member of a module refers to; ``*`` stands for all of its members."""
    module = _module(name)
    if module is None:
        return set()
    if member in module.imported:
        return {module.imported[member]}
    found, attributed = set(), set()
    for one in module.statements if member == "*" else (member, ""):
        for node in (node for statement in module.statements.get(one, ()) for node in _executed(statement)):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                target = module.imported.get(node.value.id, "")
                if target.endswith(":*"):
                    attributed.add(node.value)
                    found.add(target[:-1] + node.attr)
            elif isinstance(node, ast.Name) and node not in attributed:
                found.add(module.imported.get(node.id, f"{name}:{node.id}"))
    return found
