"""The table of models and the cache: every failure is one line that says what to do."""

from __future__ import annotations

import hashlib
import http.client
import importlib
import importlib.metadata
import io
import re
import subprocess
import sys
import tarfile
import urllib.error
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from video2anim import networks
from video2anim.errors import ModelMissingError, UsageError
from video2anim.networks import fetch, table

WEIGHTS = b"weights of a small network"
DIGEST = hashlib.sha256(WEIGHTS).hexdigest()


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "cache"
    monkeypatch.setenv(fetch.CACHE_VARIABLE, str(folder))
    return folder


@pytest.fixture
def small_models(monkeypatch: pytest.MonkeyPatch) -> None:
    """The real rows with the digest of `WEIGHTS`, but for those that come with the package."""
    rows = tuple(
        m if isinstance(m.source, table.WheelSource) else replace(m, sha256=DIGEST, size_bytes=len(WEIGHTS))
        for m in table.MODELS
    )
    monkeypatch.setattr(table, "MODELS", rows)


class _Client:
    """Stands for pip or npm: leaves a package in the folder it is run in."""

    def __init__(self, *, returncode: int = 0, stderr: str = "", content: bytes = WEIGHTS) -> None:
        self.returncode, self.stderr, self.content = returncode, stderr, content
        self.commands: list[list[str]] = []

    def __call__(self, command: list[str], *, cwd: Path, **_: object) -> subprocess.CompletedProcess[str]:
        self.commands.append(command)
        if self.returncode == 0 and "pip" in command:
            with zipfile.ZipFile(cwd / "p.whl", "w") as wheel:
                for model in table.MODELS:
                    if isinstance(model.source, table.PipSource):
                        wheel.writestr(model.source.file, self.content)
        elif self.returncode == 0:
            with tarfile.open(cwd / "p.tgz", "w:gz") as tarball:
                for model in table.MODELS:
                    if isinstance(model.source, table.NpmSource):
                        (cwd / "w").write_bytes(bytes(model.source.first_byte) + self.content)
                        tarball.add(cwd / "w", f"package/{model.source.file}")
        return subprocess.CompletedProcess(command, self.returncode, "", self.stderr)


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> _Client:
    fake = _Client()
    monkeypatch.setattr(fetch.subprocess, "run", fake)
    monkeypatch.setattr(fetch.shutil, "which", lambda name: f"/usr/bin/{name}")
    return fake


def test_rows_are_complete_and_names_unique() -> None:
    rows = networks.list_models()
    assert len({m.name for m in rows}) == len(rows)
    for row in rows:
        if isinstance(row.source, table.UserSource | table.DependencySource):
            continue
        assert len(row.sha256) == 64
        assert int(row.sha256, 16) > 0
        assert row.size_bytes > 0 or row.name == "geocalib", "its origin states no size"
        assert row.license in ("Apache-2.0", "MIT", "CC-BY-4.0"), "what is fetched may be used by anybody"
        if row.adapter:
            module, _, adapter = row.adapter.partition(":")
            assert hasattr(importlib.import_module(module), adapter)
        assert all(networks.find_model(name) for name in row.requires)


def test_weights_that_are_not_public_are_the_users_to_bring(tmp_path: Path, cache: Path) -> None:
    rows = [row for row in networks.list_models() if isinstance(row.source, table.UserSource)]
    assert {"completer", "triposr"} <= {row.name for row in rows}
    for row in rows:
        assert isinstance(row.source, table.UserSource)
        assert row.verified == "contract"
        for use in (networks.ensure, networks.pull, networks.weight_digests):
            with pytest.raises(ModelMissingError, match="is not fetched") as caught:
                use(row.name)
            line = str(caught.value)
            assert all(part in line for part in (row.source.why, row.license, row.source.origin, f"{row.name}@PATH"))
            assert "\n" not in line
    own = tmp_path / "own.onnx"
    own.write_bytes(WEIGHTS)
    assert networks.ensure(f"completer@{own}") == own
    assert networks.weight_digests(f"completer@{own}") == {"completer": DIGEST}
    # A file of that name in the cache is not taken for one the table vouches for.
    cache.mkdir()
    (cache / "completer.onnx").write_bytes(WEIGHTS)
    assert {s.entry.name: s.state for s in networks.verify()}["completer"] == "absent"


UNRUN = {"scenemi": "prior", "anny": "body", "fid": "motion-features", "gait": "walking-styles"}
"""Products that other parts of the program load."""


def test_all_data_that_comes_along_is_in_the_table() -> None:
    """Each file of weights or numbers in the repository has a row, with its digest, size and license, and the card
    beside it says the same digest."""
    root = Path(networks.__file__).parents[2]
    shipped = {
        path.relative_to(root).as_posix()
        for package in ("video2anim", "scenemi", "stages")
        for path in (root / package).rglob("*")
        if path.suffix in (".onnx", ".tflite", ".safetensors", ".npz", ".npy", ".pt", ".bin")
    }
    rows = [row for row in networks.list_models() if isinstance(row.source, table.WheelSource)]
    assert {row.source.text.removeprefix("wheel:") for row in rows} == shipped
    for row in rows:
        path = networks.model_path(row)
        assert (fetch.weights_digest(path), path.stat().st_size) == (row.sha256, row.size_bytes), (
            f"table, row {row.name}"
        )
        card = path.with_suffix(".md") if path.with_suffix(".md").is_file() else path.with_name("CARD.md")
        if card.is_file() and "sha256" in card.read_text():
            assert row.sha256 in card.read_text(), card
        assert not card.is_file() or row.license in card.read_text(), card
    assert {row.name: row.slot for row in networks.list_models() if not row.adapter} == UNRUN


@pytest.mark.parametrize("name", UNRUN)
def test_what_other_parts_load_is_listed_and_verified_but_no_network_of_a_stage(name: str) -> None:
    assert {state.entry.name: state.state for state in networks.verify()}[name] == "ready"
    assert networks.pull(name) == (networks.model_path(networks.find_model(name)),)
    with pytest.raises(UsageError, match=f"want a network that a stage runs, got {name}, which is of slot"):
        networks.load_model(name)


def test_the_prior_by_all_that_a_stage_may_call_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The digest is that of the file there is, as nothing else holds the prior to the table's."""
    row = networks.find_model("scenemi")
    for name in ("scenemi", "prior", "auto"):
        assert networks.find_model(name) == row
        assert networks.weight_digests(name) == {"scenemi": row.sha256}
    assert networks.weight_digests("interpolation") == {}
    own = tmp_path / "a folder@home" / "mine.safetensors"
    own.parent.mkdir()
    for name in (str(own), f"scenemi@{own}"):
        with pytest.raises(ModelMissingError, match="there is none; correct the path"):
            networks.weight_digests(name)
    own.write_bytes(WEIGHTS)
    for name in (str(own), f"scenemi@{own}"):
        assert networks.find_model(name).source.text == f"file:{own}"
        assert networks.weight_digests(name) == {"scenemi": DIGEST}
    monkeypatch.setattr("video2anim.networks.sources._INSTALLED", tmp_path)
    assert networks.weight_digests("auto") == {}
    with pytest.raises(ModelMissingError, match=r"came with the package and is gone.*or choose interpolation"):
        networks.weight_digests("scenemi")
    (tmp_path / "scenemi" / "weights").mkdir(parents=True)
    (tmp_path / "scenemi" / "weights" / "small.safetensors").write_bytes(WEIGHTS)
    assert networks.weight_digests("auto") == networks.weight_digests("scenemi") == {"scenemi": DIGEST}
    with pytest.raises(ModelMissingError, match="it came with the package: install that again"):
        networks.pull("scenemi")


def test_a_dependency_counts_by_its_version(monkeypatch: pytest.MonkeyPatch) -> None:
    version = importlib.metadata.version("anny")
    assert networks.weight_digests("anny") == {"anny": f"anny {version}"}
    row = networks.find_model("anny")
    assert networks.model_path(row).name == "anny"
    gone = replace(row, source=table.DependencySource("no_such_package"))
    monkeypatch.setattr(table, "MODELS", (gone,))
    assert networks.verify()[0].state == "absent"
    for use in (networks.ensure, networks.weight_digests):
        with pytest.raises(ModelMissingError, match="is gone; install no_such_package again"):
            use("anny")


NOTICED = {
    "blazepose-detector": "BlazePose", "blazepose-heavy": "BlazePose", "geocalib": "GeoCalib", "moge-2-small": "MoGe-2",
    "eomt-small-coco": "EoMT", "anny": "Anny", "objectron": "Objectron",
}  # fmt: skip
"""What the notice calls the work of others."""


def test_the_notice_tells_of_all_that_comes_along_or_is_fetched() -> None:
    """Each under its heading, with its license; the motion that own weights come from is thanked for in their cards."""
    root = Path(networks.__file__).parents[2]
    paragraphs = {}
    for paragraph in (root / "NOTICE").read_text().split("\n\n"):
        heading, _, rest = paragraph.partition("\n- ")
        paragraphs[heading.split(",")[0].split()[0]] = " ".join(rest.split())
    for row in networks.list_models():
        match row.source:
            case table.WheelSource():
                assert row.source.file in paragraphs["Part"]
                assert row.license == "Apache-2.0"
                card = networks.model_path(row).with_suffix(".md")
                if card.is_file():
                    assert "obtained from mocap.cs.cmu.edu" in " ".join(card.read_text().split()), card
            case table.DependencySource():
                assert f"{NOTICED[row.name]} body model" in paragraphs["Dependencies"]
                assert row.license.split(",")[0].removeprefix("code ") in paragraphs["Dependencies"]
            case table.UserSource():
                continue
            case _:
                assert NOTICED[row.name] in paragraphs["Fetched"]
                assert row.license in paragraphs["Fetched"].split(NOTICED[row.name], 1)[1]
    for origin in ("CMU", "DeepMimic", "ACCAD"):
        assert f"- {origin}: " in f"- {paragraphs['Their']}"


def test_slot_gives_its_first_model_and_unknown_names_the_known() -> None:
    assert networks.find_model("pose").name == "blazepose-heavy"
    with pytest.raises(UsageError, match=r"unknown model 'blazepos'; known: .*blazepose-heavy"):
        networks.find_model("blazepos")


def test_importing_models_loads_no_runtime() -> None:
    code = "import sys, video2anim.networks as m; m.list_models(); print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"cv2", "onnxruntime", "ai_edge_litert", "torch", "numpy"} & set(loaded)


@pytest.mark.usefixtures("small_models")
@pytest.mark.parametrize("name", ["blazepose-heavy", "blazepose-detector"])
def test_ensure_fetches_once_then_works_without_clients(name: str, cache: Path, client: _Client) -> None:
    told: list[tuple[str, int, int]] = []
    path = networks.ensure(name, lambda *what: told.append(what))
    assert path.read_bytes() == WEIGHTS
    assert path.parent == cache
    assert told[-1] == (name, len(WEIGHTS), len(WEIGHTS))
    assert [p.name for p in cache.iterdir()] == [path.name]
    assert networks.ensure(name) == path
    assert len(client.commands) == 1


@pytest.mark.usefixtures("cache", "client")
@pytest.mark.parametrize(("first", "end", "text"), [(2, 6, "#2-6"), (2, None, "#2-"), (0, 3, "#0-3"), (0, None, "")])
def test_a_part_of_a_file_that_packs_several(
    first: int, end: int | None, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = table.NpmSource("p", "1", "all.data", first_byte=first, end_byte=end)
    part = (bytes(first) + WEIGHTS)[first:end]
    row = replace(table.find_model("objectron"), source=source, sha256=hashlib.sha256(part).hexdigest())
    monkeypatch.setattr(table, "MODELS", (row,))
    assert source.text == f"package:npm/p@1/all.data{text}"
    assert networks.ensure("objectron").read_bytes() == part


@pytest.mark.usefixtures("small_models", "cache")
def test_pip_is_asked_for_a_fixed_wheel(client: _Client) -> None:
    networks.ensure("blazepose-detector")
    command = client.commands[0]
    assert command[:4] == [sys.executable, "-m", "pip", "download"]
    assert {"--no-deps", "--only-binary=:all:", "3.11", "mediapipe==0.10.21"} <= set(command)


@pytest.mark.usefixtures("small_models")
def test_wrong_digest_of_a_cached_file(cache: Path) -> None:
    cache.mkdir()
    (cache / "blazepose-detector.tflite").write_bytes(b"tampered")
    with pytest.raises(ModelMissingError, match=r"wanted .*came .*delete the file or run `video2anim models pull") as e:
        networks.ensure("blazepose-detector")
    assert e.value.exit_code == 4
    assert "\n" not in str(e.value)
    states = {s.entry.name: s.state for s in networks.verify()}
    assert states["blazepose-detector"] == "damaged"
    assert states["blazepose-heavy"] == "absent"


def test_weights_of_the_package_that_are_others_ask_for_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`models pull` could not bring them."""
    from video2anim.cli import main

    monkeypatch.setattr("video2anim.networks.sources._INSTALLED", tmp_path)
    weights = tmp_path / "video2anim" / "networks" / "weights"
    weights.mkdir(parents=True)
    (weights / "lifter.onnx").write_bytes(b"tampered")
    monkeypatch.setattr(sys, "argv", ["video2anim", "models", "verify"])
    with pytest.raises(SystemExit) as end:
        main.run()
    assert end.value.code == 4
    told = capsys.readouterr().err
    assert "lifter.onnx: wanted" in told
    assert "it came with the package: install that again" in told
    assert "models pull" not in told


def test_weights_that_cannot_be_read_are_named(cache: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    cache.mkdir()
    (cache / "blazepose-detector.tflite").write_bytes(WEIGHTS)
    own = tmp_path / "mine.onnx"
    own.write_bytes(WEIGHTS)
    monkeypatch.setattr(Path, "open", refuse)
    for use in (lambda: networks.ensure("blazepose-detector"), lambda: networks.weight_digests(f"completer@{own}")):
        with pytest.raises(ModelMissingError, match="want a readable file, got Permission denied at") as caught:
            use()
        assert "\n" not in str(caught.value)
    assert {state.entry.name: state.state for state in networks.verify()}["blazepose-detector"] == "damaged"


def test_a_branch_that_moved_on_is_told(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its commit is not known; the digest holds the file."""
    monkeypatch.setattr(fetch.urllib.request, "urlopen", _Addresses({"": b"another file"}))
    with pytest.raises(
        ModelMissingError, match=r"a branch, which moved on: name a file .*eomt-small-coco@PATH.*nothing"
    ):
        networks.ensure("eomt-small-coco")
    assert list(cache.iterdir()) == []


@pytest.mark.usefixtures("small_models", "client")
def test_pull_replaces_a_damaged_file_and_brings_what_is_required(cache: Path) -> None:
    cache.mkdir()
    (cache / "blazepose-heavy.tflite").write_bytes(b"tampered")
    names = [path.name for path in networks.pull("blazepose-heavy")]
    assert names == ["blazepose-detector.tflite", "blazepose-heavy.tflite"]
    assert all((cache / name).read_bytes() == WEIGHTS for name in names)


@pytest.mark.usefixtures("small_models")
def test_wrong_digest_of_a_fetched_file_keeps_nothing(cache: Path, client: _Client) -> None:
    client.content = b"another file"
    with pytest.raises(ModelMissingError, match="nothing was kept"):
        networks.ensure("blazepose-detector")
    assert list(cache.iterdir()) == []


@pytest.mark.usefixtures("cache")
def test_without_npm_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fetch.shutil, "which", lambda _: None)
    with pytest.raises(ModelMissingError, match=r"npm is not installed; install it$") as caught:
        networks.ensure("blazepose-heavy")
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("cache")
def test_a_failing_client_is_quoted_in_one_line(client: _Client) -> None:
    client.returncode, client.stderr = 1, "WARNING: slow\nERROR: No matching distribution found\n"
    with pytest.raises(ModelMissingError, match=r"pip could not fetch .*No matching distribution") as caught:
        networks.ensure("blazepose-detector")
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("cache")
def test_unwritable_cache_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv(fetch.CACHE_VARIABLE, str(blocked / "cache"))
    with pytest.raises(ModelMissingError, match=r"cannot store blazepose-detector .*VIDEO2ANIM_CACHE"):
        networks.ensure("blazepose-detector")


def test_own_file_is_taken_as_it_is(tmp_path: Path) -> None:
    own = tmp_path / "mine.onnx"
    name = f"moge-2-small@{own}"
    with pytest.raises(ModelMissingError, match="there is none; correct the path"):
        networks.ensure(name)
    own.write_bytes(WEIGHTS)
    assert networks.ensure(name) == own
    assert networks.weight_digests(name) == {"moge-2-small": DIGEST}
    assert networks.find_model(name).source.text == f"file:{own}"


def test_digests_of_a_model_name_all_its_files() -> None:
    assert set(networks.weight_digests("pose")) == {"blazepose-heavy", "blazepose-detector"}


def test_hub_address_is_pinned() -> None:
    source = networks.find_model("moge-2-small").source
    assert isinstance(source, table.HubSource)
    assert f"/resolve/{source.revision}/" in source.url
    assert len(source.revision) == 40


def test_weights_of_the_package_are_there_and_never_fetched(monkeypatch: pytest.MonkeyPatch, cache: Path) -> None:
    entry = table.find_model("lifter")
    path = fetch.ensure("lifter")
    assert path.parent.name == "weights"
    assert path.stat().st_size == entry.size_bytes
    assert not (cache / "lifter.onnx").exists()
    monkeypatch.setattr("video2anim.networks.table.WheelSource.path", cache / "gone.onnx")
    with pytest.raises(ModelMissingError, match="came with the package and is gone"):
        fetch.ensure("lifter")


class _Addresses:
    """Stands for the hosts of weights: answers with the bytes it has for an address, else as without a network."""

    def __init__(self, files: dict[str, bytes]) -> None:
        self.files, self.asked = files, []

    def __call__(self, address: str, timeout: float) -> io.BytesIO:
        self.asked.append(address)
        for tail, content in self.files.items():
            if address.endswith(tail):
                return io.BytesIO(content)
        raise urllib.error.URLError("[Errno -2] Name or service not known")


@pytest.mark.usefixtures("small_models")
def test_a_file_of_a_release(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hosts = _Addresses(
        {"/colmap/colmap/releases/download/models-geocalib-v1.0.0/geocalib_pinhole_v1.0.0.onnx": WEIGHTS}
    )
    monkeypatch.setattr(fetch.urllib.request, "urlopen", hosts)
    assert networks.ensure("geocalib") == cache / "geocalib.onnx"
    assert (cache / "geocalib.onnx").read_bytes() == WEIGHTS


def test_a_size_that_is_not_known_still_counts(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = replace(table.find_model("geocalib"), sha256=DIGEST)
    assert row.size_bytes == 0
    monkeypatch.setattr(table, "MODELS", (row,))
    monkeypatch.setattr(fetch.urllib.request, "urlopen", _Addresses({"": WEIGHTS}))
    told: list[tuple[str, int, int]] = []
    networks.ensure("geocalib", lambda *what: told.append(what))
    assert (row.name, len(WEIGHTS), 0) in told


def test_addresses_are_pinned_by_commit_or_by_digest() -> None:
    for row in networks.list_models():
        if isinstance(row.source, table.HubSource):
            assert len(row.source.revision) == 40 or row.name == "eomt-small-coco"
            assert f"/resolve/{row.source.revision}/" in row.source.url
        if isinstance(row.source, table.HubSource | table.ReleaseSource):
            assert row.source.text.endswith(f"/{row.source.file}")
            assert len(row.sha256) == 64


@pytest.mark.parametrize(
    "failure",
    [
        urllib.error.URLError("[Errno -2] Name or service not known"),
        TimeoutError("timed out"),
        http.client.RemoteDisconnected("Remote end closed connection\nwithout response"),
    ],
)
@pytest.mark.parametrize("name", ["moge-2-small", "geocalib", "eomt-small-coco"])
def test_without_network_one_line_names_the_source_and_the_way_out(
    name: str, failure: Exception, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise failure

    monkeypatch.setattr(fetch.urllib.request, "urlopen", refuse)
    source = re.escape(table.find_model(name).source.text)
    with pytest.raises(
        ModelMissingError, match=rf"cannot fetch {name} from {source}: .*{name}@PATH, or use --preset embedded"
    ) as caught:
        networks.pull(name)
    assert caught.value.exit_code == 4
    assert "\n" not in str(caught.value)
    assert [path for path in cache.rglob("*") if path.is_file()] == []


@pytest.mark.usefixtures("small_models", "client")
def test_pull_standard_without_network_ends_with_code_4(
    cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What comes from packages is fetched and kept; the hub cannot be reached."""
    from video2anim.cli import main

    hosts = _Addresses({})
    monkeypatch.setattr(fetch.urllib.request, "urlopen", hosts)
    monkeypatch.setattr(sys, "argv", ["video2anim", "models", "pull", "standard"])
    with pytest.raises(SystemExit) as end:
        main.run()
    assert end.value.code == 4
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert re.match(r"video2anim: cannot fetch \S+ from (hub|release):\S+: .*Name or service not known", line)
    assert "--preset embedded, which works without it" in line
    assert "blazepose-heavy.tflite" in [path.name for path in cache.iterdir()]
    assert len(hosts.asked) == 1


@pytest.mark.usefixtures("small_models", "client", "cache")
def test_pull_standard_fetches_and_checks_everything_of_the_preset(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from video2anim.cli import main
    from video2anim.cli.compose import preset_models

    monkeypatch.setattr(fetch.urllib.request, "urlopen", _Addresses({"": WEIGHTS}))
    monkeypatch.setattr(sys, "argv", ["video2anim", "models", "pull", "standard"])
    with pytest.raises(SystemExit) as end:
        main.run()
    assert end.value.code == 0
    printed = capsys.readouterr().out
    states = {state.entry.name: state for state in networks.verify()}
    for name in preset_models("standard"):
        assert states[name].state == "ready"
        assert str(states[name].path) in printed


def test_the_list_shows_size_licence_and_source_of_all(
    cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from video2anim.cli import show

    monkeypatch.setattr(show, "_out", Console(width=400))
    show.models_table(networks.verify())
    lines = {line.split()[1]: line for line in capsys.readouterr().out.splitlines()[1:] if line.strip()}
    for row in networks.list_models():
        assert row.license in lines[row.name]
        assert row.source.text in lines[row.name]
        assert "contract" in lines[row.name] or "weights" in lines[row.name]
    assert "140.9 MB" in lines["moge-2-small"]
