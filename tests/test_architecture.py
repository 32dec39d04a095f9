"""The shape of the code, read from its syntax trees: who imports whom, who prints, how long objects are."""

from __future__ import annotations

import ast
import functools
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGES = ("video2anim", "scenemi", "stages")
LEVELS = {
    "video2anim": 0, "video2anim.types": 0, "video2anim.geometry": 0, "video2anim.body": 0, "video2anim.errors": 0,
    "video2anim.digest": 0, "video2anim.mesh_file": 0,
    "scenemi": 1, "video2anim.networks": 1, "video2anim.artifacts": 1, "video2anim.video": 1,
    "video2anim.background": 2, "video2anim.depth": 2, "video2anim.humans": 2,
    "video2anim.objects": 2, "video2anim.scene": 2, "video2anim.tracking": 2,
    "video2anim.calibration": 3, "video2anim.camera": 3, "video2anim.motion": 3,
    "video2anim.pipeline": 4, "video2anim.viewer": 4, "video2anim.export": 4,
    "stages": 5, "video2anim.lab": 5,
    "video2anim.cli": 6,
}  # fmt: skip
"""Part -> level. Lower never imports higher."""
MAY_SEE = {
    ("video2anim.export", "video2anim.viewer"),
    ("video2anim.export", "video2anim.pipeline"),
}
"""Pairs of one level, (importer, imported), that the design allows; level 0 is one whole."""
HOMES = {
    "onnxruntime": ("video2anim/networks/", "scenemi/model/onnx_denoiser.py"),
    "ai_edge_litert": ("video2anim/networks/",),
    "open3d": ("video2anim/viewer/",),
}
"""Libraries that only these folders may import."""
FORBIDDEN = ("pickle", "cloudpickle", "dill", "shelve", "marshal")
PICKLE_READER = "video2anim/body/array_pickle.py"
"""Reads the users' SMPL and PROX files by an unpickler that admits a short list of names; nothing else of pickle may be
used."""
FILE_LINES, FUNCTION_LINES = 400, 80


def sources() -> list[Path]:
    """All runtime modules; templates are programs for other interpreters."""
    found = [path for package in PACKAGES for path in sorted((REPOSITORY / package).rglob("*.py"))]
    return [path for path in found if "templates" not in path.parts]


def relative(path: Path) -> str:
    return path.relative_to(REPOSITORY).as_posix()


@functools.cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(), str(path))


def module_name(path: Path) -> str:
    parts = list(path.relative_to(REPOSITORY).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@functools.cache
def imported(path: Path) -> tuple[tuple[str, int, bool], ...]:
    """Absolute name, line, and whether it runs at import time, of every import; typing-only ones too."""
    return tuple(read_imports(path))


def read_imports(path: Path) -> Iterator[tuple[str, int, bool]]:
    whole = tree(path)
    inner = {
        id(node)
        for function in ast.walk(whole)
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        for node in ast.walk(function)
    }
    typing_only = {
        id(node)
        for block in ast.walk(whole)
        if isinstance(block, ast.If) and ast.unparse(block.test).endswith("TYPE_CHECKING")
        for node in ast.walk(block)
    }
    for node in ast.walk(whole):
        runs_now = id(node) not in inner | typing_only
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, node.lineno, runs_now
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{relative(path)}:{node.lineno}: relative import"
            assert node.module is not None
            for alias in node.names:
                yield f"{node.module}.{alias.name}", node.lineno, runs_now


def part_of(name: str) -> str | None:
    """The longest part of the table that a dotted name lies in; None for other libraries."""
    pieces = name.split(".")
    if pieces[0] not in PACKAGES:
        return None
    for length in (2, 1):
        if (candidate := ".".join(pieces[:length])) in LEVELS:
            return candidate
    raise AssertionError(f"{name} belongs to no part of the level table")


def test_every_module_belongs_to_a_part() -> None:
    folders = {module_name(path).split(".")[1] for path in (REPOSITORY / "video2anim").glob("*/__init__.py")}
    assert {f"video2anim.{folder}" for folder in folders} | {"video2anim.errors"} <= set(LEVELS)
    assert {path.name for path in (REPOSITORY / "video2anim").glob("*.py")} == {
        "__init__.py", "digest.py", "errors.py", "mesh_file.py"
    }  # fmt: skip


def test_lower_levels_never_import_higher_ones_nor_siblings() -> None:
    wrong = []
    for path in sources():
        here = part_of(module_name(path))
        assert here is not None
        for name, line, _ in imported(path):
            there = part_of(name)
            if there is None or there == here or LEVELS[there] < LEVELS[here]:
                continue
            both_base = LEVELS[here] == LEVELS[there] == 0
            if not both_base and (here, there) not in MAY_SEE:
                wrong.append(f"{relative(path)}:{line} imports {name}")
    assert not wrong


def test_scenemi_sees_only_the_base() -> None:
    wrong = [
        f"{relative(path)}:{line} imports {name}"
        for path in sources()
        if (here := part_of(module_name(path))) == "scenemi"
        for name, line, _ in imported(path)
        if (there := part_of(name)) not in (None, here) and LEVELS[there] != 0
    ]
    assert not wrong


def test_stages_never_import_another_stage() -> None:
    wrong = [
        f"{relative(path)}:{line} imports {name}"
        for path in sources()
        if relative(path).startswith("stages/")
        for name, line, _ in imported(path)
        if name.split(".")[0] == "stages"
    ]
    assert not wrong


def unread(whole: ast.Module) -> list[str]:
    """Parameters that a function's body never names, but `config` and `ctx` of stages; protocols have no bodies."""
    found = []
    for node in ast.walk(whole):
        if isinstance(node, ast.FunctionDef) and ast.unparse(node.body[-1]) != "...":
            named = {n.id for part in node.body for n in ast.walk(part) if isinstance(n, ast.Name)}
            parameters = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
            given = {"self", "cls", "_"} | ({"config", "ctx"} if parameters[-2:] == ["config", "ctx"] else set())
            found += [f"{node.name}({name})" for name in parameters if name not in named | given]
    return found


def test_stages_read_what_they_take() -> None:
    """An input that is never read makes a stage run again for nothing."""
    wrong = {relative(path): unread(tree(path)) for path in sources() if relative(path).startswith("stages/")}
    assert not {path: names for path, names in wrong.items() if names}
    assert unread(ast.parse("def f(a, b, *, c):\n    return a + c")) == ["f(b)"]


def test_only_the_command_line_imports_stages() -> None:
    importers = {
        relative(path).rsplit("/", 1)[0]
        for path in sources()
        for name, _, _ in imported(path)
        if name.split(".")[0] == "stages"
    }
    assert importers == {"video2anim/cli"}


def test_scenemi_meets_the_pipeline_in_few_stages() -> None:
    """The in-betweening model is used by `refine`; its measures (section 9 of the design) by whoever reports them; its
    readers of motion data by whoever makes synthetic clips or trains on motion."""
    users: dict[str, set[str]] = {}
    for path in sources():
        if not relative(path).startswith("scenemi/"):
            for name, _, _ in imported(path):
                if name.split(".")[0] == "scenemi":
                    users.setdefault(relative(path), set()).add(name)
    for path_name, names in users.items():
        if path_name != "stages/refine.py" and not path_name.startswith("video2anim/motion/"):
            reads_motion = path_name.startswith("video2anim/lab/")
            seen = "scenemi." if reads_motion else "scenemi.metrics"
            assert all(name.startswith(seen) for name in names), f"{path_name} imports {names}"
    assert "stages/refine.py" in users


@pytest.mark.parametrize("library", HOMES)
def test_library_stays_at_home(library: str) -> None:
    users = {relative(path) for path in sources() for name, _, _ in imported(path) if name.split(".")[0] == library}
    assert users, f"nobody imports {library}: is the rule out of date?"
    assert all(user.startswith(HOMES[library]) for user in users), users


def test_no_pickle() -> None:
    wrong = []
    for path in sources():
        names = [(name, line) for name, line, _ in imported(path) if name.split(".")[0] in FORBIDDEN]
        if relative(path) != PICKLE_READER:
            wrong += [f"{relative(path)}:{line}" for _, line in names]
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
                assert isinstance(node.value, ast.Constant)
                if node.value.value is not False:
                    wrong.append(f"{relative(path)}:{node.value.lineno}")
            if isinstance(node, ast.Call) and ast.unparse(node.func) in ("torch.load", "joblib.load", "pd.read_pickle"):
                wrong.append(f"{relative(path)}:{node.lineno}")
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "np.load":
                given = {keyword.arg for keyword in node.keywords}
                assert "allow_pickle" in given, f"{relative(path)}:{node.lineno}: np.load without allow_pickle=False"
    assert not wrong


def test_pickle_reader_only_derives_a_restricted_unpickler() -> None:
    whole = tree(REPOSITORY / PICKLE_READER)
    used = [
        node.attr
        for node in ast.walk(whole)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "pickle"
    ]
    assert set(used) == {"Unpickler", "UnpicklingError"}
    assert not [node for node in ast.walk(whole) if isinstance(node, ast.ImportFrom) and node.module == "pickle"]
    (derived,) = [
        node
        for node in ast.walk(whole)
        if isinstance(node, ast.ClassDef) and "pickle.Unpickler" in map(ast.unparse, node.bases)
    ]
    assert used.count("Unpickler") == 1, "only as the base of the restricted one"
    assert [m.name for m in derived.body if isinstance(m, ast.FunctionDef)] == ["find_class"]
    assert "super" not in ast.unparse(derived), "names are never looked up in the usual way"


def test_only_the_command_line_prints() -> None:
    wrong = []
    for path in sources():
        if relative(path).startswith(("video2anim/cli/", "scenemi/cli")):
            continue
        called = [node for node in ast.walk(tree(path)) if isinstance(node, ast.Call)]
        printing = ("print", "sys.stdout.write", "sys.stderr.write")
        wrong += [f"{relative(path)}:{node.lineno}" for node in called if ast.unparse(node.func) in printing]
        wrong += [
            f"{relative(path)}:{line} imports {name}"
            for name, line, _ in imported(path)
            if name.split(".")[0] in ("rich", "typer", "click", "tqdm")
        ]
    assert not wrong


def test_no_bare_except() -> None:
    wrong = [
        f"{relative(path)}:{node.lineno}"
        for path in sources()
        for node in ast.walk(tree(path))
        if isinstance(node, ast.ExceptHandler) and node.type is None
    ]
    assert not wrong


def test_files_and_functions_stay_short() -> None:
    wrong = []
    for path in sources():
        lines = len(path.read_text().splitlines())
        if lines > FILE_LINES:
            wrong.append(f"{relative(path)}: {lines} lines, at most {FILE_LINES}")
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                assert node.end_lineno is not None
                length = node.end_lineno - node.lineno + 1
                if length > FUNCTION_LINES:
                    wrong.append(
                        f"{relative(path)}:{node.lineno} {node.name}: {length} lines, at most {FUNCTION_LINES}"
                    )
    assert not wrong


def test_public_functions_have_docstrings() -> None:
    wrong = [
        f"{relative(path)}:{node.lineno} {node.name}"
        for path in sources()
        for node in tree(path).body
        if isinstance(node, ast.FunctionDef | ast.ClassDef)
        and not node.name.startswith("_")
        and isinstance(node, ast.FunctionDef)
        and ast.get_docstring(node) is None
    ]
    assert not wrong


def test_all_functions_are_annotated() -> None:
    wrong = []
    for path in sources():
        for node in ast.walk(tree(path)):
            if not isinstance(node, ast.FunctionDef):
                continue
            arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            bare = [a.arg for a in arguments if a.annotation is None and a.arg not in ("self", "cls")]
            if bare or (node.returns is None and node.name != "__init__"):
                wrong.append(f"{relative(path)}:{node.lineno} {node.name} {bare}")
    assert not wrong


def test_no_machine_paths() -> None:
    """A path of somebody's machine in the code would work there only."""
    wrong = [
        relative(path)
        for path in sources()
        for node in ast.walk(tree(path))
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and any(mark in node.value for mark in ("/home/", "/Users/", "/mnt/"))
    ]
    assert not wrong


def loaded_after(code: str) -> set[str]:
    """Top-level modules in a fresh interpreter after some code."""
    probe = f"import sys\n{code}\nsys.stderr.write('\\n'.join(sorted({{m.split('.')[0] for m in sys.modules}})))"
    done = subprocess.run([sys.executable, "-c", probe], cwd=REPOSITORY, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return set(done.stderr.splitlines())


def test_help_loads_no_heavy_library() -> None:
    code = (
        "import sys; sys.argv = ['video2anim', '--help']\n"
        "from video2anim.cli.main import run\n"
        "try:\n    run()\nexcept SystemExit as end:\n    assert not end.code\n"
    )
    loaded = loaded_after(code)
    assert "typer" in loaded
    assert not loaded & {"torch", "open3d", "cv2", "scipy", "trimesh", "av", "numpy", "matplotlib", "anny", "stages"}


def test_stage_modules_load_no_heavy_library() -> None:
    """The runner imports all of them to read their signatures."""
    names = sorted(path.stem for path in (REPOSITORY / "stages").glob("*.py") if path.stem != "__init__")
    loaded = loaded_after("\n".join(f"import stages.{name}" for name in names))
    assert {"stages", "numpy"} <= loaded
    assert not loaded & {"torch", "open3d", "cv2", "scipy", "trimesh", "av", "matplotlib", "anny", "onnxruntime"}


def test_types_and_scenemi_import_alone() -> None:
    assert not loaded_after("import video2anim.types") & {"torch", "cv2", "scipy", "av", "anny", "scenemi", "stages"}
    assert not loaded_after("import scenemi") & {"stages", "av", "open3d", "onnxruntime", "ai_edge_litert", "typer"}
