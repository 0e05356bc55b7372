"""The structure itself: which way imports point, how large modules are, what is documented and what is promised."""

import ast
import json
import os
import re
import statistics
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ["toolkit/calib_toolkit", "plugins/calib_toolkit_plugins", "datasets/calib_toolkit_datasets"]
MODULES = sorted(file for package in PACKAGES for file in (ROOT / package).rglob("*.py"))
HEAVY = {"open3d", "cv2", "small_gicp", "matplotlib"}
GENERATED = re.compile(r"\.git|\.venv|build|dist|__pycache__|\..*_cache|\.hypothesis|calib-out.*|.*\.egg-info")
WRITTEN = {".py", ".md", ".toml", ".yaml", ".cff", ".csv", ""}
TREES = {file: ast.parse(file.read_text()) for file in MODULES}


def name(file):
    return str(file.relative_to(ROOT))


def imports(nodes):
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""


def texts():
    """Every file of ours that people read: (path, content)."""
    for folder, folders, files in os.walk(ROOT):
        folders[:] = [f for f in folders if not GENERATED.fullmatch(f)]
        for file in files:
            path = Path(folder, file)
            if path.suffix in WRITTEN and path.stat().st_size < 1_000_000:
                yield path, path.read_text(encoding="utf-8")


def packages_loaded_by(code):
    code = f"import sys; {code}; print(*{{m.split('.')[0] for m in sys.modules}})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_import_contracts_hold():
    command = [Path(sys.executable).with_name("lint-imports"), "--no-cache"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("file", [m for m in MODULES if "toolkit/calib_toolkit/" in name(m)], ids=name)
def test_the_core_imports_no_plugin_and_no_reader(file):
    for module in imports(ast.walk(TREES[file])):
        assert not module.startswith(("calib_toolkit_plugins", "calib_toolkit_datasets")), module


@pytest.mark.parametrize("file", [m for m in MODULES if "toolkit/calib_toolkit/" not in name(m)], ids=name)
def test_plugins_and_readers_use_public_names_only(file):
    own = file.relative_to(ROOT).parts[1]
    allowed = {"calib_toolkit", *(f"calib_toolkit.{name}" for name in ("se3", "errors", "types", "tables"))}
    for module in imports(ast.walk(TREES[file])):
        if module.startswith("calib_toolkit"):
            assert module in allowed or module.split(".")[0] == own, module


@pytest.mark.parametrize("file", MODULES, ids=name)
def test_no_module_is_above_300_lines(file):
    assert len(file.read_text().splitlines()) <= 300


def test_the_median_module_is_small():
    lengths = [len(m.read_text().splitlines()) for m in MODULES if m.name != "__init__.py"]
    assert statistics.median(lengths) <= 150


@pytest.mark.parametrize("file", MODULES, ids=name)
def test_whatever_is_public_has_a_docstring(file):
    def public(node, where):
        for child in node.body:
            if isinstance(child, ast.FunctionDef | ast.ClassDef) and not child.name.startswith("_"):
                overload = any(ast.unparse(d) == "overload" for d in child.decorator_list)
                if not overload and not ast.get_docstring(child):
                    yield f"{where}{child.name}"
                if isinstance(child, ast.ClassDef):
                    yield from public(child, f"{where}{child.name}.")

    assert ast.get_docstring(TREES[file]), "the module has no docstring"
    assert list(public(TREES[file], "")) == []


@pytest.mark.parametrize("file", MODULES, ids=name)
def test_heavy_libraries_are_imported_where_they_are_used(file):
    top = {module.split(".")[0] for module in imports(TREES[file].body)}
    assert not top & HEAVY


def test_nothing_that_is_read_can_be_run():
    """No reader unpickles, unpacks or takes YAML's tags; the kit for plugins' authors pickles what it made itself."""
    unsafe = re.compile(
        r"allow_pickle=True|unpack_archive|yaml\.(unsafe_|full_)?load\(|joblib\.load|UnsafeLoader|FullLoader"
    )
    for file in MODULES:
        imported = {module.split(".")[0] for module in imports(ast.walk(TREES[file]))}
        assert not imported & {"pickle", "marshal", "shelve", "zipfile", "tarfile"} or file.name == "checks.py", name(
            file
        )
        assert not unsafe.search(file.read_text()), name(file)
        for call in re.findall(r"np\.load\((.*)\)", file.read_text()):
            assert "allow_pickle=False" in call, name(file)


def test_help_does_not_wait_for_numpy():
    assert not {"numpy", "scipy", "rich", *HEAVY} & packages_loaded_by("import calib_toolkit.cli")


def test_tables_do_not_wait_for_estimators():
    code = "import sys, calib_toolkit.cli.tables; print({'scipy.stats', 'calib_toolkit.joint'} & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


def test_the_registry_does_not_wait_for_heavy_libraries():
    assert not HEAVY & packages_loaded_by("from calib_toolkit.plugins import registry; registry()")


def test_the_bare_folders_shadow_no_package():
    for folder in ("toolkit", "plugins", "datasets"):
        assert not (ROOT / folder / "__init__.py").exists()


def test_tests_need_unique_names_and_no_packages():
    tests = [f for f in (ROOT / "tests").rglob("*.py") if "__pycache__" not in f.parts]
    assert not [name(f) for f in tests if f.name == "__init__.py"]
    names = [f.name for f in tests if f.name != "conftest.py"]
    assert sorted(names) == sorted(set(names))


def test_nothing_names_a_path_of_one_machine():
    folders = "|".join(["work", "home", "Users", "root", "mnt"])
    found = [
        f"{name(path)}:{i}: {line.strip()}"
        for path, text in texts()
        for i, line in enumerate(text.splitlines(), 1)
        if re.search(rf"(?<![\w.}}$])/({folders})/\w", line)
    ]
    assert found == []


def test_every_link_in_the_documents_leads_somewhere():
    dead = [
        f"{name(page)}: {link}"
        for page, text in texts()
        if page.suffix == ".md"
        for link in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text)
        if "://" not in link and not link.startswith("mailto:") and not (page.parent / link).exists()
    ]
    assert dead == []


def blocks(page, language="python"):
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)


@pytest.mark.parametrize("code", blocks("docs/conventions.md"))
def test_the_examples_of_the_conventions_hold(code):
    exec(code, {})


def test_the_example_calibration_is_json_and_the_examples_of_tables_are_toml():
    assert [json.loads(block)["base"] for block in blocks("docs/formats.md", "json")] == ["velo"]
    rig, options = (tomllib.loads(block) for block in blocks("docs/formats.md", "toml"))
    (first_rig,) = (tomllib.loads(block) for block in blocks("README.md", "toml"))
    assert list(rig) == list(first_rig) == ["sensors"]
    assert options["sensors"]


def test_the_example_options_are_accepted(tmp_path):
    from calib_toolkit.config import read_config

    (tmp_path / "options.toml").write_text(blocks("docs/formats.md", "toml")[1])
    assert read_config(tmp_path / "options.toml").duration == 200.0


def test_python_in_the_readme_uses_names_that_exist():
    import calib_toolkit

    (code,) = blocks("README.md")
    (line,) = [n for n in ast.parse(code).body if isinstance(n, ast.ImportFrom)]
    assert {alias.name for alias in line.names} <= set(calib_toolkit.__all__)


def test_what_the_readme_runs_exists():
    import click

    from calib_toolkit.cli import main

    readme = (ROOT / "README.md").read_text()
    commands = set(re.findall(r"calib-toolkit (?!-)([a-z]+) ?(?=[A-Z\n`-])", readme))
    scripts = set(re.findall(r"script/[a-z]+", readme))
    assert {"run", "inspect", "plugins"} <= commands <= set(main.list_commands(click.Context(main)))
    assert {"script/demo", "script/test"} <= scripts
    assert not [s for s in scripts if not os.access(ROOT / s, os.X_OK)]


def test_what_the_paper_map_names_exists():
    """Every ``module.name`` in code quotes, but for configuration keys and the paper's own symbols."""
    text = (ROOT / "docs/paper-map.md").read_text()
    rooms = {
        "calib_toolkit": "delta likelihood observability rotation se3 sync timing translation",
        "calib_toolkit_plugins": "epipolar gps_ins monocular registration two_view velodyne",
        "calib_toolkit_datasets": "simulated",
    }
    homes = {room: package for package, names in rooms.items() for room in names.split()}
    named = [n.split(".") for n in re.findall(r"`([a-z][a-z0-9_]*(?:\.[A-Za-z_]+)+)`", text)]
    found = [n for n in named if n[0] in homes]
    assert len(found) > 30
    for room, name, *attribute in found:
        module = import_module(f"{homes[room]}.{room}")
        options = {field for o in vars(module).values() for field in getattr(o, "__dataclass_fields__", ())}
        assert hasattr(module, name) or name in options, f"{room}.{name}"
        if attribute:
            members = getattr(module, name)
            assert hasattr(members, attribute[0]) or attribute[0] in members.__dataclass_fields__


@pytest.mark.parametrize("language", ["sh", "bash"])
def test_scripts_parse(language):
    scripts = [ROOT / ".ci/run"] if language == "bash" else sorted((ROOT / "script").iterdir())
    for script in scripts:
        assert script.read_text().startswith(("#!/bin/sh", "#!/usr/bin/env bash"))
        subprocess.run([language, "-n", script], check=True)


def test_the_version_is_in_the_changelog():
    version = re.search(r'^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)[1]
    assert re.search(rf"^## \[?{re.escape(version)}\b", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert f"version: {version}\n" in (ROOT / "CITATION.cff").read_text()
