import ast
import importlib.util
import io
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

import hybridkin
from hybridkin.native import library

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

ROOT = Path(__file__).parent.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PYPROJECT["project"]
REPOSITORY = PROJECT["urls"]["Repository"]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
MODULES = {"scikit-learn": "sklearn"}  # where the name of a package is not that of its module


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Return the paths of sdist and wheel, built as `python -m build` does."""
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("dist")
    build(folder, "h.build_sdist(sys.argv[1]); h.build_wheel(sys.argv[1])")
    (sdist,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    return sdist, wheel


def build(folder, what, root=ROOT, **environment):
    """Return what is said on stderr."""
    command = [sys.executable, "-c", f"import hatchling.build as h, sys; {what}", folder]
    environment = {**os.environ, **environment}
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stderr


@pytest.fixture(scope="module")
def hatch_build():
    pytest.importorskip("hatchling")
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


needs_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="needs a C compiler"
)


def name_of(requirement):
    return re.split(r"[^\w-]", requirement)[0]


def modules_of(requirements):
    """Return the modules that requirements bring."""
    names = [name_of(requirement) for requirement in requirements]
    return {MODULES.get(name, name).replace("-", "_") for name in names}


def imports_of(tree, everywhere):
    """Return what a file imports, as it is opened or everywhere."""
    nodes = ast.walk(tree) if everywhere else ast.iter_child_nodes(tree)
    found = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module.split(".")[0])
    found = {"matplotlib" if name == "mpl_toolkits" else name for name in found}
    return found - {*sys.stdlib_module_names, "hybridkin"}


@pytest.mark.slow
def test_what_a_test_may_need_is_named():
    """Each skip says "needs ..." with a word of the table, or imports a module of the table."""
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = re.search(r"\| tests need \|.*?\n((?:\|.*\n)+)", page)[1].splitlines()[1:]
    named = {what.strip(" `") for row in rows for what in row.split("|")[1].split(",")}
    used = set()
    for path in (ROOT / "tests").rglob("*.py"):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            kind = getattr(call.func, "attr", "") if isinstance(call, ast.Call) else ""
            if kind == "importorskip":
                used.add(call.args[0].value.partition(".")[0])
            elif kind in ("skip", "skipif"):
                reason = {k.arg: k.value for k in call.keywords}.get("reason", call.args[0])
                text = reason.values[0] if isinstance(reason, ast.JoinedStr) else reason
                assert text.value.startswith("needs "), f"{path}:{call.lineno}"
                used.add(re.split("[:;]", text.value.removeprefix("needs "))[0])
    assert {"pandas", "a C compiler"} <= used <= named


@pytest.mark.slow
def test_a_skipped_test_fails_where_everything_must_run(tmp_path):
    shutil.copy(ROOT / "tests" / "conftest.py", tmp_path)
    (tmp_path / "test_one.py").write_text(
        "import pytest\n"
        "def test_gpu(): pytest.skip('needs a GPU')\n"
        "@pytest.mark.skipif(True, reason='needs Octave')\n"
        "def test_octave(): pass\n"
    )
    (tmp_path / "test_other.py").write_text("import pytest\npytest.importorskip('absent_peer')")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", tmp_path]
    command.append("--continue-on-collection-errors")
    environment = {**os.environ, "HYBRIDKIN_MUST_RUN": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert "1 skipped, 2 errors" in done.stdout, done.stdout


def test_versions_and_dates_agree():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {hybridkin.__version__}\n" in citation
    headings = re.findall(
        r"^## \[(.+?)\](?: - (.*))?$", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE
    )
    assert headings[0] == ("Unreleased", "")
    version, date = headings[1]
    assert version == hybridkin.__version__
    assert f"\ndate-released: {date}\n" in citation
    assert "version" in PROJECT["dynamic"]


def test_the_repository_has_one_address():
    assert all(
        url.startswith(REPOSITORY)
        for name, url in PROJECT["urls"].items()
        if name != "Documentation"
    )
    host, owner, name = REPOSITORY.rsplit("/", 2)
    assert PROJECT["urls"]["Documentation"] == f"https://{owner}.github.io/{name}/main/"
    assert host == "https://github.com"
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nrepository-code: {REPOSITORY}\n" in citation


def test_classifiers_are_the_versions_and_systems_that_are_tested():
    tests = (ROOT / ".github" / "workflows" / "tests.yml").read_text(encoding="utf-8")
    versions = re.findall(r'"(3\.\d+)"', re.search(r"python: \[(.*)\]", tests)[1])
    named = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
    assert named == versions
    assert f">={versions[0]}" == PROJECT["requires-python"]
    for runner, system in (("ubuntu", "Linux"), ("macos", "MacOS"), ("windows", "Windows")):
        assert f"{runner}-latest" in tests
        assert any(f":: {system}" in classifier for classifier in PROJECT["classifiers"])


def test_needs_of_contributors_are_groups_and_features_are_extras():
    extras = PROJECT["optional-dependencies"]
    assert {*extras} == {"sim", "dask", "view", "parquet", "full"}
    features = {*re.search(r"\[(.*)\]", extras["full"][0])[1].split(",")}
    assert features == {*extras} - {"full"}
    published = set().union(*map(modules_of, extras.values()))
    assert not published & {"pytest", "ruff", "sphinx", "jax"}


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_actions_are_pinned_and_pull_requests_may_not_write(workflow):
    text = workflow.read_text(encoding="utf-8")
    uses = re.findall(r"uses: (.*)", text)
    assert uses
    for action in uses:
        pinned = re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+", action)
        assert pinned or action.startswith("./"), action
    for_all, jobs = re.split(r"^jobs:\n", text, flags=re.MULTILINE)
    assert "\npermissions:\n  contents: read\n" in for_all
    for job in re.split(r"^  (?=\w+:\n)", jobs, flags=re.MULTILINE):
        if ": write" in job and "pull_request" in for_all:
            assert "if: github.event_name == 'push'" in job


@pytest.mark.slow
def test_what_is_imported_is_declared():
    needed = modules_of(PROJECT["dependencies"])
    extras = PROJECT["optional-dependencies"]
    used = ("sim", "dask", "parquet", "view")
    optional = needed.union(*(modules_of(extras[extra]) for extra in used))
    for path in (ROOT / "hybridkin").rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        assert imports_of(tree, everywhere=False) <= needed, path
        assert imports_of(tree, everywhere=True) <= optional, path


@pytest.mark.slow
def test_the_wheel_holds_the_package_and_nothing_else(built):
    wheel = zipfile.ZipFile(built[1])
    names = {*wheel.namelist()}
    assert {"hybridkin/py.typed", "hybridkin/datasets/data/trunk.npz"} <= names
    sources = {str(p.relative_to(ROOT).as_posix()) for p in (ROOT / "hybridkin").rglob("*.py")}
    assert sources <= names
    tops = {name.split("/")[0] for name in names}
    assert tops == {"hybridkin", f"hybridkin-{hybridkin.__version__}.dist-info"}
    assert not any("__pycache__" in name or "test" in name for name in names)
    # Twice what it holds today: a recording or a folder of builds that slips in is larger.
    assert built[1].stat().st_size < 5_000_000


@pytest.mark.slow
def test_the_sdist_is_the_repository(built):
    names = {name.split("/", 1)[1] for name in tarfile.open(built[0]).getnames()}
    # What a clone of the repository has, and nothing that was made in it.
    made = {"__pycache__", "_build", "gallery", "api", "lib"}
    for folder in (".ci", ".github", "docs", "examples", "hybridkin", "tests"):
        files = [path.relative_to(ROOT) for path in (ROOT / folder).rglob("*") if path.is_file()]
        assert {p.as_posix() for p in files if not made & {*p.parts}} <= names
    single = {"pyproject.toml", "LICENSE", "CONTRIBUTING.md", "Makefile", "hatch_build.py"}
    assert single <= names
    assert not [name for name in names if made & {*Path(name).parts}]
    # Twice what it holds today, of which three fifths are pictures; the index takes 100 MB.
    assert built[0].stat().st_size < 10_000_000
    wheel = zipfile.ZipFile(io.BytesIO(built[1].read_bytes()))
    package = {name for name in wheel.namelist() if name.startswith("hybridkin/")}
    assert {name for name in package if "/lib/hk_" not in name} <= names


@pytest.mark.slow
def test_the_page_of_the_index_has_absolute_links(built):
    wheel = zipfile.ZipFile(built[1])
    (metadata,) = (name for name in wheel.namelist() if name.endswith("/METADATA"))
    page = wheel.read(metadata).decode().partition("\n\n")[2]
    links = re.findall(r"\]\(([^)\s]+)\)|\b(?:src|href)=\"([^\"]+)\"", page)
    targets = [markdown or html for markdown, html in links]
    assert len(targets) > 5
    for target in targets:
        assert re.match(r"https://|#", target), target
        place, _, path = target.partition(f"/v{hybridkin.__version__}/")
        if place in (f"{REPOSITORY}/blob", f"{REPOSITORY}/raw"):
            assert (ROOT / path.partition("#")[0]).is_file(), target
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    anywhere = re.compile(rf"{re.escape(REPOSITORY)}/(blob|raw)/v[\d.]+/")
    assert anywhere.sub("", page).strip() == readme.strip()


def test_links_of_markdown_and_html_become_absolute_and_code_stays(hatch_build):
    text = (
        '[a](docs/a.md#b) [![p](p/q.png)](c.md) <img src="x.gif"> [`f`](d.py) [i](#j) '
        "[h](https://h.org/k) `[0](x)`\n```python\nf[0](docs/a.md)\n```\n[e](e.svg)"
    )
    assert hatch_build.with_absolute_links(text, "R", "v1") == (
        "[a](R/blob/v1/docs/a.md#b) [![p](R/raw/v1/p/q.png)](R/blob/v1/c.md) "
        '<img src="R/raw/v1/x.gif"> [`f`](R/blob/v1/d.py) [i](#j) '
        "[h](https://h.org/k) `[0](x)`\n```python\nf[0](docs/a.md)\n```\n[e](R/raw/v1/e.svg)"
    )


@needs_compiler
@pytest.mark.slow
def test_the_wheel_holds_kernels_for_this_platform(built, hatch_build, tmp_path):
    assert built[1].name.endswith(f"-py3-none-{hatch_build.host()}.whl")
    zipfile.ZipFile(built[1]).extractall(tmp_path)
    code = "import hybridkin; print(hybridkin.native.library.library()._name)"
    command, environment = [sys.executable, "-c", code], {**os.environ, "PYTHONPATH": str(tmp_path)}
    environment.pop("HYBRIDKIN_NATIVE", None)
    said = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert said.stdout.startswith(str(tmp_path)), said.stderr


@pytest.mark.skipif(os.name == "nt", reason="needs POSIX: shell scripts")
def test_only_what_has_changed_is_compiled_again(hatch_build, tmp_path, monkeypatch):
    compiler = tmp_path / "cc"
    compiler.write_text("""#!/bin/sh
        if [ "$*" = --version ]; then cat "$0.version"; exit; fi
        while [ "$1" != -o ]; do shift; done
        date +%s%N > "$2"
    """)
    compiler.chmod(0o755)
    version = tmp_path / "cc.version"
    monkeypatch.setenv("CC", str(compiler))

    def compiled():
        libraries = hatch_build.compile_into(tmp_path / "lib", "linux_x86_64", [])
        return [path.read_text() for path in sorted(libraries)]

    version.write_text("1")
    first = compiled()
    assert len(set(first)) == 3
    assert compiled() == first
    version.write_text("2")
    second = compiled()
    assert not set(first) & set(second)
    (tmp_path / "lib" / "hk_v3.so").unlink()
    assert [old == new for old, new in zip(second, compiled(), strict=True)] == [True, False, True]
    monkeypatch.setitem(hatch_build.X86, "v2", "-O1")
    assert compiled()[0] != second[0]


@needs_compiler
@pytest.mark.slow
def test_miscompiled_kernels_are_refused(hatch_build, tmp_path, monkeypatch):
    native, host = tmp_path / "native", hatch_build.host()
    shutil.copytree(ROOT / "hybridkin" / "native" / "src", native / "src")
    monkeypatch.setenv("CC", f"{hatch_build.compiler()[0]} -Dsin=cos")
    monkeypatch.setitem(hatch_build.X86, "v2", "-msse4.2 -O0")  # in less time
    monkeypatch.delenv("HYBRIDKIN_NATIVE", raising=False)
    hatch_build.compile_into(native / "lib", host, ["v2"] if host.endswith("x86_64") else [])
    monkeypatch.setattr(library, "_FOLDER", native)
    library._opened.cache_clear()
    try:
        with pytest.warns(UserWarning, match="computes wrong numbers; compile it anew by `"):
            assert library.library() is None
    finally:
        library._opened.cache_clear()
