"""The rules of the house that no linter knows: they hold for every file, so nobody has to remember them."""

import ast
import importlib.metadata
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import jax.numpy as jnp
import pytest
from jax.dtypes import TypePromotionError
from jaxtyping import TypeCheckError
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from mbdpg.interfaces import EnvSpec

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = sorted((ROOT / "mbdpg").rglob("*.py"))
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
BANNED_MODULES = {"yaml", *PYPROJECT["tool"]["ruff"]["lint"]["flake8-tidy-imports"]["banned-api"]}
BROUGHT_BY_AN_EXTRA = {"box2d"}  # gymnasium[box2d] chooses the version


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def in_package(path: Path) -> ast.Module:
    return ast.parse(path.read_text(), filename=str(path))


def kept_files() -> list[Path]:
    """Every file that git keeps, or would keep if it were added now."""
    git = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    listing = subprocess.run(git, cwd=ROOT, capture_output=True, text=True, check=False)
    if listing.returncode:
        pytest.skip("not a git checkout")
    return [ROOT / name for name in listing.stdout.split("\0") if name and (ROOT / name).is_file()]


def imported_modules(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module.split(".")[0]


def ways_to_run_a_file(tree: ast.Module) -> list[str]:
    """What in this code could let a checkpoint, a config or a data file run code."""
    found = [f"imports {module}" for module in imported_modules(tree) if module in BANNED_MODULES]
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        if isinstance(node.func, ast.Name) and node.func.id in {"eval", "exec", "compile", "__import__"}:
            found.append(f"calls {node.func.id}")
        for keyword in node.keywords:
            forbids = isinstance(keyword.value, ast.Constant) and keyword.value.value is False
            if keyword.arg == "allow_pickle" and not forbids:
                found.append("lets NumPy unpickle")
    return found


@pytest.mark.parametrize("path", PACKAGE, ids=relative)
def test_no_file_can_run_code(path: Path) -> None:
    assert not ways_to_run_a_file(in_package(path))


@pytest.mark.parametrize(
    "source",
    ["import pickle", "from pickle import loads", "import yaml", "eval (text)", "np.load(file, allow_pickle = flag)"],
)
def test_the_rule_above_sees(source: str) -> None:
    assert ways_to_run_a_file(ast.parse(source))


@pytest.mark.parametrize("path", PACKAGE, ids=relative)
def test_files_and_functions_stay_short(path: Path) -> None:
    lines = path.read_text().count("\n")
    assert lines < 300, "split the file: one noun each"
    long = {
        node.name: node.end_lineno - node.lineno + 1
        for node in ast.walk(in_package(path))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno
    }
    assert not {name: lines for name, lines in long.items() if lines >= 60}


def test_files_are_named_after_their_noun() -> None:
    nameless = {"utils", "util", "common", "helpers", "helper", "misc", "base", "manager"}
    assert not [relative(path) for path in PACKAGE if nameless & {path.stem, path.parent.name}]


def test_nothing_mentions_a_home_folder_or_a_package_index() -> None:
    home = r"(?<![\w.])/(?:home|root|Users)/[\w.]"
    index = r"(?:extra[-_])?index[-_]url|find[-_]links|trusted[-_]host|pythonhosted|pypi\.org/simple"
    wrong = re.compile(f"{home}|{re.escape(str(ROOT))}|{index}", re.IGNORECASE)
    mentions = []
    for path in kept_files():
        if path == Path(__file__):
            continue  # it has to spell out what it looks for
        for number, line in enumerate(path.read_text(errors="ignore").splitlines(), start=1):
            if wrong.search(line):
                mentions.append(f"{relative(path)}:{number}: {line.strip()[:100]}")
    assert not mentions


def pins(name: str) -> dict[str, str]:
    """Package name to exact version, from a requirements file and the ones that it includes."""
    found: dict[str, str] = {}
    for line in (ROOT / name).read_text().splitlines():
        if line.startswith("-r "):
            found |= pins(line.removeprefix("-r "))
        elif line and not line.startswith("#"):
            pin = re.fullmatch(r"([\w.-]+)==([\w.!+]+)(?: *;.+)?", line)
            assert pin, f"{name}: {line!r} is not name==version"
            found[canonicalize_name(pin[1])] = pin[2]
    return found


PROJECT = PYPROJECT["project"]
EXTRAS = [*PROJECT["optional-dependencies"]["ray"], *PROJECT["optional-dependencies"]["sweep"]]
DEPENDENCIES = [
    *((line, "requirements.txt") for line in PROJECT["dependencies"]),
    *((line, "requirements-dev.txt") for line in PROJECT["optional-dependencies"]["dev"]),
    *((line, "requirements-extras.txt") for line in EXTRAS),
]


@pytest.mark.parametrize(("line", "file"), DEPENDENCIES)
def test_each_dependency_is_pinned_within_its_range_and_explained(line: str, file: str) -> None:
    requirement = Requirement(line)
    assert requirement.specifier.contains(pins(file)[canonicalize_name(requirement.name)])
    assert f"`{requirement.name}" in (ROOT / "docs" / "dependencies.md").read_text()


def test_what_the_package_imports_is_declared() -> None:
    lines = [*PROJECT["dependencies"], *EXTRAS]
    declared = {canonicalize_name(Requirement(line).name) for line in lines} | BROUGHT_BY_AN_EXTRA
    imported = {module for path in PACKAGE for module in imported_modules(in_package(path))}
    distributions = importlib.metadata.packages_distributions()
    undeclared = {
        module
        for module in imported - {"mbdpg"} - set(sys.stdlib_module_names)
        if not declared & {canonicalize_name(name) for name in distributions.get(module, [module])}
    }
    assert not undeclared


def test_mixed_dtypes_and_ranks_are_errors_here() -> None:
    ones = jnp.ones((2, 3))
    with pytest.raises(TypePromotionError):
        ones + jnp.ones((2, 3), jnp.int32)
    with pytest.raises(ValueError, match="jax_numpy_rank_promotion"):
        ones + jnp.ones(3)


def test_shapes_and_types_are_checked_at_each_call_here() -> None:
    with pytest.raises(TypeCheckError):
        EnvSpec(id="Hopper-v5", observation_size="11", action_size=3, episode_limit=None, reference_return=None)
