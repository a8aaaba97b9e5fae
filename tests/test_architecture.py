"""The import law and the house's rules of form, read from the source."""

from __future__ import annotations

import ast
import builtins
import symtable
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = {
    "mjx_refine": ROOT / "mjx_refine",
    "mjx_fitness": ROOT / "fitness/mjx_fitness",
    "mjx_cmaes": ROOT / "cmaes/mjx_cmaes",
}

# From the ground up: a part may import parts of lower layers and itself, never one beside it in the same layer or above.
LAYERS = (
    {"errors"},
    {"files"},
    {"scene"},
    {"rotations"},
    {"batch", "observation", "compile_cache", "children", "linear_algebra"},
    {"effects"},
    {"sim", "view", "space"},
    {"gradients"},
    {"search"},
    {"diagnosis"},
    {"simulate", "export", "observe", "guess", "describe"},
    {"evaluate", "generate"},
    {"report", "edit"},
    {"many"},
    {"__init__"},
    {"cli"},
    {"__main__"},
)
# Within a part whose modules are many, likewise: a package or module of it may import those of lower layers and itself.
INNER = {
    "diagnosis": (
        {"result"},
        {"seen"},
        {"fits"},
        {"misfit"},
        {"search"},
        {"answer"},
        {"diagnose"},
        {"poses"},
        {"joint"},
        {"recorded"},
        {"__init__"},
    ),
}
# Which of the other two packages a part may import; they import nothing of ours.
BORDERS = {"search": {"mjx_cmaes", "mjx_fitness"}, "view": {"mjx_fitness"}, "evaluate": {"mjx_fitness"}, "guess": {"mjx_fitness"},
           "report": {"mjx_fitness"}}  # fmt: skip
MOST_LINES = 400
MOST_FUNCTION_LINES = 60


def files() -> list[Path]:
    return [path for folder in PACKAGES.values() for path in sorted(folder.rglob("*.py"))]


FILES = files()
IDS = [str(path.relative_to(ROOT)) for path in FILES]
every_file = pytest.mark.parametrize("path", FILES, ids=IDS)


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(), filename=str(path))


def module_name(path: Path) -> str:
    """The dotted name of a file."""
    for name, folder in PACKAGES.items():
        if path.is_relative_to(folder):
            parts = [name, *path.relative_to(folder).with_suffix("").parts]
            return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
    raise ValueError(path)


MODULES = {module_name(path): path for path in FILES}


def imports(path: Path) -> set[str]:
    """Modules of ours that a file imports, anywhere in it, also inside functions."""
    found = set()
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                raise ValueError(f"{path}: a relative import; write the whole name")
            base = node.module or ""
            found |= {f"{base}.{alias.name}" if f"{base}.{alias.name}" in MODULES else base for alias in node.names}
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "import_module":
            found |= {arg.value for arg in node.args if isinstance(arg, ast.Constant) and isinstance(arg.value, str)}
    return {name for name in found if name.split(".")[0] in PACKAGES}


def part(module: str) -> str:
    """The part of mjx_refine that a module belongs to: ``mjx_refine.search.run`` -> ``search``."""
    return inner(module, 1)


def inner(module: str, depth: int = 2) -> str:
    """The same within a part: ``mjx_refine.diagnosis.fits.pace`` -> ``fits``."""
    names = module.split(".")
    return names[depth] if len(names) > depth else "__init__"


def breaches(module: str, imported: set[str]) -> list[str]:
    """What in a module's imports is against the law."""
    package = module.split(".")[0]
    level = {name: height for height, names in enumerate(LAYERS) for name in names}
    found = []
    for other in sorted(imported):
        if other.split(".")[0] != package:
            if package != "mjx_refine" or other.split(".")[0] not in BORDERS.get(part(module), set()):
                found.append(f"{module} imports {other}")
        elif package == "mjx_refine" and part(other) != part(module) and level[part(other)] >= level[part(module)]:
            found.append(f"{module} (layer {level[part(module)]}) imports {other} (layer {level[part(other)]})")
        elif part(other) == part(module) and (layers := INNER.get(part(module))):
            floor = {name: height for height, names in enumerate(layers) for name in names}
            if inner(other) != inner(module) and floor[inner(other)] >= floor[inner(module)]:
                found.append(f"{module} (layer {floor[inner(module)]}) imports {other} (layer {floor[inner(other)]})")
    return found


@every_file
def test_imports_go_down(path):
    assert breaches(module_name(path), imports(path)) == []


def test_every_part_has_a_layer():
    assert sorted({part(module) for module in MODULES if module.startswith("mjx_refine")}) == sorted(
        set().union(*LAYERS)
    )


@pytest.mark.parametrize("name", INNER)
def test_every_module_of_a_layered_part_has_a_layer(name):
    assert sorted({inner(module) for module in MODULES if part(module) == name}) == sorted(set().union(*INNER[name]))


def circles(edges: dict[str, set[str]]) -> list[list[str]]:
    """Modules that import one another, directly or by others."""
    reach = {name: set(targets) for name, targets in edges.items()}
    for middle in edges:
        for name in edges:
            if middle in reach[name]:
                reach[name] |= reach[middle]
    rings = {
        tuple(sorted(other for other in reach[name] if name in reach[other])) for name in edges if name in reach[name]
    }
    return [list(ring) for ring in sorted(rings)]


def test_no_module_is_in_a_circle():
    assert circles({name: (imports(path) & MODULES.keys()) - {name} for name, path in MODULES.items()}) == []


def test_circles_are_found():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}) == [["b", "c"]]


@pytest.mark.parametrize(
    ("module", "imported"),
    [
        ("mjx_cmaes.state", "mjx_fitness"),
        ("mjx_cmaes.state", "mjx_refine.errors"),
        ("mjx_fitness.sums", "mjx_refine"),
        ("mjx_refine.scene.read", "mjx_refine.cli"),
        ("mjx_refine.sim.c", "mjx_refine.search.options"),
        ("mjx_refine.sim.c", "mjx_refine.view.rays"),
        ("mjx_refine.diagnosis.fits.pace", "mjx_refine.diagnosis.search.compare"),
        ("mjx_refine.diagnosis.seen.measure", "mjx_refine.diagnosis.fits.fit"),
        ("mjx_refine.scene.read", "mjx_cmaes"),
        ("mjx_refine.guess.guess", "mjx_refine.export"),
        ("mjx_refine.search.run", "mjx_refine"),
    ],
)
def test_the_law_forbids(module, imported):
    assert breaches(module, {imported}) != []


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("import mjx_refine.cli", "mjx_refine.cli"),
        ("from mjx_refine import errors", "mjx_refine.errors"),
        ("def f():\n    from mjx_refine.scene import Scene", "mjx_refine.scene"),
        ("import importlib\nimportlib.import_module('mjx_cmaes')", "mjx_cmaes"),
    ],
)
def test_imports_are_found(source, name, tmp_path):
    path = tmp_path / "m.py"
    path.write_text(source)
    assert imports(path) == {name}


@every_file
def test_no_file_is_long(path):
    assert len(path.read_text().splitlines()) <= MOST_LINES


def length(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function, its docstring aside."""
    first = node.body[0]
    said = (first.end_lineno or 0) - first.lineno + 1 if ast.get_docstring(node) else 0
    return (node.end_lineno or 0) - node.lineno + 1 - said


@every_file
def test_no_function_is_long(path):
    functions = [node for node in ast.walk(tree(path)) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    assert {node.name: length(node) for node in functions if length(node) > MOST_FUNCTION_LINES} == {}


@every_file
def test_validation_does_not_use_assert_and_no_except_is_bare(path):
    asserts = [node.lineno for node in ast.walk(tree(path)) if isinstance(node, ast.Assert)]
    bare = [node.lineno for node in ast.walk(tree(path)) if isinstance(node, ast.ExceptHandler) and node.type is None]
    assert (asserts, bare) == ([], [])


def calls(path: Path, owner: str, names: set[str]) -> list[ast.Call]:
    """Calls such as ``np.load(...)``."""
    return [
        node
        for node in ast.walk(tree(path))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr in names
        and isinstance(node.func.value, ast.Name)
        and node.func.value.id == owner
    ]


@every_file
def test_nothing_that_is_read_can_run_code(path):
    for call in [*calls(path, "np", {"load"}), *calls(path, "numpy", {"load"})]:
        flags = [keyword.value for keyword in call.keywords if keyword.arg == "allow_pickle"]
        assert [isinstance(flag, ast.Constant) and flag.value is False for flag in flags] == [True], call.lineno
    assert [
        c.lineno for c in calls(path, "yaml", {"load", "load_all", "full_load", "unsafe_load", "unsafe_load_all"})
    ] == []
    names = {
        name.name.split(".")[0] for node in ast.walk(tree(path)) if isinstance(node, ast.Import) for name in node.names
    }
    assert names.isdisjoint({"pickle", "marshal", "shelve", "dill", "joblib"})
    builtins = [n.func.id for n in ast.walk(tree(path)) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)]
    assert {"eval", "exec"}.isdisjoint(builtins)


def test_yaml_is_read_with_safe_loaders_alone():
    used = {
        node.attr
        for path in FILES
        for node in ast.walk(tree(path))
        if isinstance(node, ast.Attribute)
        and node.attr.endswith("Loader")
        and isinstance(node.value, ast.Name)
        and node.value.id == "yaml"
    }
    assert used == {"SafeLoader"}


def test_the_names_on_pypi_are_left_alone():
    for folder in ("cmaes", "fitness"):
        assert not (ROOT / folder / "__init__.py").exists()
        assert [p.name for p in (ROOT / folder).iterdir() if p.name != "__pycache__"] == [f"mjx_{folder}"]


@every_file
def test_every_public_function_says_what_it_does(path):
    public = [
        node
        for node in tree(path).body
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_")
    ]
    assert [node.name for node in public if not ast.get_docstring(node)] == []


# --- names ------------------------------------------------------------------------------------------------------------


def undefined(source: str) -> set[str]:
    """Global names that code refers to and nothing defines.

    Linters cannot say so here: jaxtyping's shapes look like names to them.
    """
    top = symtable.symtable(source, "<source>", "exec")
    bound = {s.get_name() for s in top.get_symbols() if s.is_assigned() or s.is_imported() or s.is_namespace()}
    bound |= {"__file__", "__name__", "__doc__", "__path__", *dir(builtins)}
    found: set[str] = set()
    tables = [top]
    while tables:
        table = tables.pop()
        tables += table.get_children()
        names = [s.get_name() for s in table.get_symbols() if s.is_referenced() and (table is top or s.is_global())]
        found |= set(names) - bound
    return found


@every_file
def test_every_name_is_defined(path):
    assert undefined(path.read_text()) == set()


def test_names_that_nothing_defines_are_found():
    source = (
        "from __future__ import annotations\nimport math\nSIZE = 2\n\n"
        'def of(x: Float[np.ndarray, "rows columns"]) -> int:\n'
        "    def inner():\n        return x + SIZE + math.pi + len(missing) + [y for y in x]\n    return inner()\n"
    )
    assert undefined(source) == {"missing"}
