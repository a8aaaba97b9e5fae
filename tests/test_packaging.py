"""The wheel: what it owns, that it works elsewhere and leaves PyPI's `cmaes` alone; the lock file; the README's example."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from configparser import ConfigParser
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = {"mjx_refine": "mjx_refine", "mjx_fitness": "fitness/mjx_fitness", "mjx_cmaes": "cmaes/mjx_cmaes"}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def run(*command: str, cwd: Path, path: str = "") -> str:
    """Runs Python and returns what it printed."""
    environment = {**os.environ, "PYTHONPATH": path}
    done = subprocess.run(
        [sys.executable, *command], cwd=cwd, env=environment, capture_output=True, text=True, timeout=500
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel, built from a copy."""
    copy = tmp_path_factory.mktemp("source")
    for name in ("mjx_refine", "fitness", "cmaes"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, copy)
    run("-m", "build", "--wheel", "--no-isolation", "--outdir", str(copy / "dist"), str(copy), cwd=copy)
    (built,) = (copy / "dist").iterdir()
    return built


@pytest.fixture(scope="module")
def unpacked(wheel, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def test_the_wheel_owns_only_our_packages(unpacked):
    assert sorted(path.name for path in unpacked.iterdir()) == sorted(
        [*PACKAGES, f"mjx_refine-{PROJECT['version']}.dist-info"]
    )


def test_the_wheel_holds_every_file_of_the_packages(unpacked):
    for name, folder in PACKAGES.items():
        mine = {p.relative_to(ROOT / folder) for p in (ROOT / folder).rglob("*") if p.is_file() and p.suffix != ".pyc"}
        theirs = {p.relative_to(unpacked / name) for p in (unpacked / name).rglob("*") if p.is_file()}
        assert mine == theirs
    assert (unpacked / "mjx_refine/report/template.html").stat().st_size > 0


def test_the_wheel_declares_the_command(unpacked):
    entries = ConfigParser()
    entries.read(unpacked / f"mjx_refine-{PROJECT['version']}.dist-info" / "entry_points.txt")
    assert dict(entries["console_scripts"]) == {"refine": "mjx_refine.cli:main"}


def test_the_wheel_works_from_another_folder(unpacked, tmp_path):
    code = (
        "import sys, mjx_refine, mjx_fitness, mjx_cmaes\n"
        "print([m.__file__ for m in (mjx_refine, mjx_fitness, mjx_cmaes)])\n"
        "from mjx_refine.cli.main import run\n"
        "sys.exit(run(['--version']))\n"
    )
    out = run("-c", code, cwd=tmp_path, path=str(unpacked))
    assert out.count(str(unpacked)) == 3
    assert PROJECT["version"] in out


def test_the_names_on_pypi_stay_theirs(tmp_path):
    """Optuna's sampler imports PyPI's `cmaes`, also where our folder of that name is in sight."""
    code = (
        "import cmaes, mjx_cmaes, optuna\n"
        "optuna.logging.disable_default_handler()\n"
        "study = optuna.create_study(sampler=optuna.samplers.CmaEsSampler(seed=0, n_startup_trials=1))\n"
        "study.optimize(lambda t: t.suggest_float('x', -1, 1) ** 2 + t.suggest_float('y', -1, 1) ** 2, n_trials=5)\n"
        "print(len(study.trials), cmaes.CMA.__module__, cmaes.__file__)\n"
    )
    path = os.pathsep.join(str(ROOT / name) for name in ("", "fitness", "cmaes"))
    count, module, file = run("-c", code, cwd=ROOT, path=path).split()
    assert count == "5"
    assert module == "cmaes._cma"
    assert not Path(file).is_relative_to(ROOT / "cmaes")


def test_mujoco_and_mjx_are_pinned_as_a_pair():
    pins = [text for text in PROJECT["dependencies"] if text.startswith("mujoco")]
    assert {pin.split("==")[0] for pin in pins} == {"mujoco", "mujoco-mjx"}
    assert len({pin.split("==")[1] for pin in pins}) == 1


@pytest.mark.parametrize("name", ["uv.lock", "pyproject.toml"])
def test_no_private_place_is_named(name):
    text = (ROOT / name).read_text()
    assert set(re.findall(r"https?://([^/\"]+)", text)) <= {"pypi.org", "files.pythonhosted.org"}
    assert re.findall(r"file:|/root/|/home/|/tmp/|/opt/", text) == []


def test_the_lock_knows_every_dependency():
    lock = tomllib.loads((ROOT / "uv.lock").read_text())
    (mine,) = (package for package in lock["package"] if package["name"] == PROJECT["name"])

    def name(text: str) -> str:
        return re.split(r"[\s\[<>=!~;]", text, maxsplit=1)[0].lower()

    wanted = {(name(text), "") for text in PROJECT["dependencies"]}
    for extra, texts in PROJECT["optional-dependencies"].items():
        wanted |= {(name(text), extra) for text in texts}
    wanted = {pair for pair in wanted if pair[0] != PROJECT["name"]}
    locked = {
        (entry["name"], (re.findall(r"extra == '([^']+)'", entry.get("marker", "")) or [""])[0])
        for entry in mine["metadata"]["requires-dist"]
    }
    assert wanted <= locked
    versions = {package["name"]: package.get("version") for package in lock["package"]}
    for text in PROJECT["dependencies"]:
        if "==" in text:
            assert versions[name(text)] == text.split("==")[1]


def test_continuous_integration_runs_the_readme_s_command():
    script = ROOT / ".ci" / "run"
    assert os.access(script, os.X_OK)
    command = script.read_text().strip().splitlines()[-1]
    parts = [part.strip() for part in command.split("&&")]
    assert parts[-1].endswith("pytest -q")
    readme = (ROOT / "README.md").read_text()
    assert all(part in readme for part in parts), f"README.md does not tell the tests' command: {parts}"


def readme_example() -> str:
    """The first Python block of the README."""
    found = re.search(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.DOTALL | re.MULTILINE)
    assert found, "README.md holds no ```python block"
    return found[1]


def test_the_readme_s_example_runs(tmp_path):
    code = readme_example()
    assert 3 <= len(code.splitlines()) <= 30
    assert "mjx_refine" in code
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    path = os.pathsep.join(str(ROOT / name) for name in ("", "fitness", "cmaes"))
    run("-W", "error::DeprecationWarning:__main__", "-c", code, cwd=tmp_path, path=path)
