"""The public surface: what `dir(vcal)` shows, and no name that is both a module and a function."""

import importlib
import pkgutil
import subprocess
import sys
import types
from pathlib import Path

import pytest

import vcal


def packages():
    yield "vcal"
    for found in pkgutil.walk_packages(vcal.__path__, "vcal."):
        if found.ispkg:
            yield found.name


PACKAGES = sorted(packages())


def exported(package):
    return getattr(importlib.import_module(package), "__all__", ())


def submodules(package):
    return {found.name for found in pkgutil.iter_modules(importlib.import_module(package).__path__)}


def test_the_packages_are_found():
    assert {"vcal", "vcal.design", "vcal.design.spaces", "vcal.reproduce"} <= set(PACKAGES)
    assert "optimiser" in submodules("vcal.design") and "optimise" in exported("vcal.design")


@pytest.mark.parametrize("package", PACKAGES)
def test_every_exported_name_exists_once(package):
    names = exported(package)
    assert len(set(names)) == len(names)
    missing = [name for name in names if not hasattr(importlib.import_module(package), name)]
    assert missing == []


@pytest.mark.parametrize("package", PACKAGES)
def test_no_exported_name_is_also_a_submodule(package):
    """A catalogue may export its leaf modules themselves, under their own names."""
    module = importlib.import_module(package)
    shared = set(exported(package)) & submodules(package)
    clashes = [n for n in sorted(shared) if not isinstance(getattr(module, n), types.ModuleType)]
    assert clashes == []


def test_dir_shows_the_public_names_only():
    assert dir(vcal) == sorted([*vcal.__all__, "__version__"])
    assert 15 <= len(dir(vcal)) <= 25
    assert isinstance(vcal.identify, types.FunctionType)
    assert isinstance(vcal.close_loop, types.FunctionType)


def test_importing_vcal_imports_nothing_that_takes_long():
    """JAX is imported when something is used, matplotlib when something is drawn."""
    code = "import sys, vcal; vcal.__version__; dir(vcal); heavy = 'jax equinox optimistix scipy '"
    code += "'numpy matplotlib pydantic'; print([m for m in heavy.split() if m in sys.modules])"
    code += "; vcal.identify; print('jax' in sys.modules, 'matplotlib' in sys.modules)"
    code += "; print(vcal.uncertainty.propagate.__name__)"
    root = str(Path(vcal.__file__).parents[1])
    found = subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True
    )
    assert found.stdout.split("\n")[:3] == ["[]", "True False", "propagate"]


@pytest.mark.slow
def test_nothing_imported_is_left_under_a_public_name():
    """In a process of its own: the test session has imported further subpackages."""
    code = "import vcal, types; vcal.identify; print([n for n, v in vars(vcal).items() "
    code += "if not n.startswith('_') and n not in vcal.__all__ "
    code += "and not isinstance(v, types.ModuleType)])"
    code += "; print(hasattr(vcal, 'jax'))"
    root = str(Path(vcal.__file__).parents[1])
    found = subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True
    )
    assert found.stdout.split("\n")[:2] == ["[]", "False"]
