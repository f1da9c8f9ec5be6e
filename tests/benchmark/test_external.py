"""External commands as methods: files, frames and direction, every way to end, and what is told of it."""

from __future__ import annotations

import csv
import importlib
import json
import subprocess
import sys
import textwrap
from pathlib import Path

import helpers_programs as programs
import numpy as np
import pytest
from helpers_paths import REPOSITORY

from mtpcr_geo.benchmark import methods
from mtpcr_geo.benchmark.baselines import external, normals, process
from mtpcr_geo.benchmark.baselines.fpfh import Features
from mtpcr_geo.benchmark.baselines.open3d import import_open3d
from mtpcr_geo.benchmark.baselines.teaser import FpfhTeaser
from mtpcr_geo.benchmark.pairs import write_laz
from mtpcr_geo.benchmark.protocol import run_protocol
from mtpcr_geo.benchmark.runs import write_results
from mtpcr_geo.benchmark.worker import StartRange
from mtpcr_geo.core import transforms
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import MissingPartError, OptionError

FOLDER = REPOSITORY / "examples" / "external"
T_TRUE = transforms.compose(
    transforms.yaw_matrix(np.deg2rad(140)) @ transforms.tilt_matrix(0.4, np.deg2rad(3)),
    np.array([40.0, -25.0, 6.0]),
)

SCRIPT = """
import sys, threading
import numpy as np
what, source, target, result = sys.argv[1:]
if what == "fail":
    sys.exit("not today")
if what == "hang":
    threading.Event().wait()
if what == "eat":
    held = [bytearray(2**26) for _ in range(64)]
read = np.load if source.endswith("npy") else np.loadtxt
T = np.eye(4)
T[:3, 3] = read(target).mean(axis=0) - read(source).mean(axis=0)
with open(result, "w") as file:
    if what == "short":
        T = T[:2]
    file.write(f"target: cloud_1.ply 2\\n{T}\\n")
"""


def external_method(folder: Path, what: str, **more) -> external.External:
    (folder / "method.py").write_text(SCRIPT)
    command = [sys.executable, "{here}/method.py", what, "{source}", "{target}", "{result}"]
    (folder / "method.json").write_text(json.dumps({"command": command, "format": "npy"} | more))
    made = methods.make_method(f"external:file={folder / 'method.json'}")
    assert isinstance(made, external.External)
    return made


@pytest.mark.parametrize("form", ["npy", "xyz"])
def test_external_command_gives_its_transform(tmp_path, form):
    xyz = np.random.default_rng(0).normal(size=(50, 3)).round(6)
    answer = external_method(tmp_path, "work", format=form).estimate(xyz, xyz + [1.0, 2.0, 3.0], seed=0)
    assert answer.reason == ""
    assert answer.T_target_source is not None
    assert np.allclose(answer.T_target_source, transforms.translation((1.0, 2.0, 3.0)), atol=1e-6)


@pytest.mark.parametrize(
    ("what", "more", "reason"),
    [
        ("fail", {}, "exit code 1: not today"),
        ("hang", {"time_limit_s": 0.5}, "time limit of 0.5 s"),
        ("eat", {"memory_limit_mib": 2000, "environment": {"OPENBLAS_NUM_THREADS": "1"}}, "MemoryError"),
        ("short", {}, "8 numbers"),
    ],
)
def test_external_command_that_fails_is_a_run_without_answer(tmp_path, what, more, reason):
    if what == "eat" and sys.platform != "linux":
        pytest.skip("address space cannot be limited here")
    xyz = np.zeros((5, 3))
    answer = external_method(tmp_path, what, **more).estimate(xyz, xyz, seed=0)
    assert answer.T_target_source is None
    assert reason in answer.reason


def test_scale_in_an_external_answer_is_taken_out():
    rigid = transforms.compose(transforms.yaw_matrix(0.3), np.array([1.0, 2.0, 3.0]))
    centroid = np.array([50.0, 20.0, 5.0])
    scaled = rigid @ transforms.translation(centroid) @ np.diag([1.02, 1.02, 1.02, 1.0])
    T, scale = external.rigid_part(scaled @ transforms.translation(-centroid), centroid)
    assert scale == pytest.approx(1.02)
    assert np.allclose(T, rigid)


def test_external_point_files_hold_the_points(tmp_path):
    xyz = np.random.default_rng(1).uniform(-50, 50, (200, 3))
    described = external.Description(command=["x"])
    external.write_points(tmp_path / "a.ply", xyz, described)
    head, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    assert b"element vertex 200" in head
    assert np.array_equal(np.frombuffer(body).reshape(-1, 3), xyz)
    import laspy

    described = external.Description(command=["x"], format="laz", crs=25832)
    external.write_points(tmp_path / "a.laz", xyz, described)
    las = laspy.read(tmp_path / "a.laz")
    assert np.abs(las.xyz - xyz).max() < 0.0006
    assert las.header.parse_crs().to_epsg() == 25832


def test_described_commands_of_other_projects_are_valid():
    names = {path.stem for path in FOLDER.glob("*.json")}
    assert names == {
        "codem", "geotransformer", "geotransformer_kitti", "map_closures", "plade", "predator", "sylva",
    }  # fmt: skip
    readme = (FOLDER / "README.md").read_text()
    for path in FOLDER.glob("*.json"):
        described = external.read_description(path)
        words = " ".join(described.command)
        assert all(word in words for word in ("{source}", "{target}", "{result}"))
        assert f"`{path.name}`" in readme
        assert described.note
        for word in described.command:
            if word.startswith("{here}/"):
                assert (FOLDER / word.removeprefix("{here}/")).is_file()


def standin(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> external.External:
    """Set a description's variables to its stand-in."""
    programs.write(folder / "modules", {"solving.py": programs.SOLVING})
    python = {f"{word}_PYTHON": sys.executable for word in ("CODEM", "SYLVA", "MAP_CLOSURES", "PREDATOR")}
    variables = python | {"GEOTRANSFORMER_PYTHON": sys.executable, "PYTHONPATH": str(folder / "modules")}
    if name == "plade":
        program = folder / "PLADE"
        text = programs.PLADE.format(python=sys.executable, folder=str(folder / "modules"))
        programs.write(folder, {"PLADE": textwrap.dedent(text).lstrip()})
        program.chmod(0o755)
        variables["PLADE"] = str(program)
    elif name.startswith("geotransformer"):
        sizes = {"3dmatch": ("0.025", "4"), "kitti": ("0.3", "5")}
        for kind, (voxel, stages) in sizes.items():
            (place,) = (word for word in GEOTRANSFORMER_EXPERIMENTS if kind in word)
            files = {
                f"checkout/experiments/{place}/{key}": text.replace("{voxel}", voxel).replace(
                    "{stages}", stages
                )
                for key, text in programs.EXPERIMENT.items()
            }
            programs.write(folder, files)
        programs.write(folder / "checkout", programs.GEOTRANSFORMER)
        programs.write(folder, {"modules/torch.py": programs.TORCH, "weights.pth.tar": "trained"})
        variables |= {"GEOTRANSFORMER": str(folder / "checkout")}
        variables |= {"GEOTRANSFORMER_WEIGHTS": str(folder / "weights.pth.tar")}
    elif name == "predator":
        programs.write(folder / "checkout", programs.PREDATOR)
        programs.write(folder / "modules", {"torch.py": programs.TORCH, "easydict.py": programs.EASYDICT})
        variables["PREDATOR"] = str(folder / "checkout")
    else:
        files = {"sylva": programs.SYLVA, "map_closures": programs.MAP_CLOSURES, "codem": programs.CODEM}[
            name
        ]
        programs.write(folder / "modules", files)
    for key, value in variables.items():
        monkeypatch.setenv(key, value)
    return external.External(str(FOLDER / f"{name}.json"))


GEOTRANSFORMER_EXPERIMENTS = (
    "geotransformer.3dmatch.stage4.gse.k3.max.oacl.stage2.sinkhorn",
    "geotransformer.kitti.stage5.gse.k3.max.oacl.stage2.sinkhorn",
)


@pytest.mark.parametrize(
    "name", ["plade", "geotransformer", "geotransformer_kitti", "predator", "sylva", "map_closures", "codem"]
)
def test_wrapper_gives_the_transform_from_source_to_target_both_ways(name, tmp_path, monkeypatch):
    if name == "predator":
        # in a process of its own, as the wrapper does: here a test before this one may have loaded libusb
        found = subprocess.run([sys.executable, "-c", "import open3d"], capture_output=True, check=False)
        if found.returncode:
            pytest.skip("Open3D cannot be imported (extra benchmark, and libusb of the system)")
    method = standin(name, tmp_path, monkeypatch)
    rng = np.random.default_rng(7)
    source = programs.scattered(rng) + [20.0, 5.0, 2.0]
    target = transforms.apply(T_TRUE, source)[rng.permutation(len(source))]
    for here, there, T_true in ((source, target, T_TRUE), (target, source, transforms.inverse(T_TRUE))):
        answer = method.estimate(here, there, seed=3)
        assert answer.reason == ""
        assert answer.T_target_source is not None
        moved = transforms.apply(answer.T_target_source, here)
        assert np.abs(moved - transforms.apply(T_true, here)).max() < 0.01
        assert answer.details["scale"] == pytest.approx(1.0, abs=1e-4)


def test_program_that_wants_normals_says_so_without_them(tmp_path, monkeypatch):
    method = standin("plade", tmp_path, monkeypatch)
    method.description = method.description.model_copy(update={"format": "ply"})
    xyz = programs.scattered(np.random.default_rng(1))
    answer = method.estimate(xyz, xyz, seed=0)
    assert answer.T_target_source is None
    assert answer.reason == "exit code 1: loading target point cloud failed; registration failed"
    assert answer.printed == "loading target point cloud failed\nregistration failed\n"


def test_variable_that_is_not_set_is_said_before_any_run(monkeypatch):
    monkeypatch.delenv("PLADE", raising=False)
    with pytest.raises(MissingPartError, match=r"the variable PLADE, which is not set: PLADE, github\.com"):
        methods.make_method(f"external:file={FOLDER / 'plade.json'}")
    with pytest.raises(OptionError, match="above 0"):
        methods.make_method(f"external:file={FOLDER / 'codem.json'},voxel=0")


def test_learned_method_in_training_would_give_the_truth_it_is_given(tmp_path, monkeypatch):
    # the stand-in's model, as the real one, answers with the identity it is given unless in evaluation mode
    method = standin("geotransformer", tmp_path, monkeypatch)
    path = tmp_path / "checkout" / "experiments" / GEOTRANSFORMER_EXPERIMENTS[0] / "model.py"
    path.write_text(path.read_text().replace("self.training = False", "pass"))
    xyz = programs.scattered(np.random.default_rng(1))
    answer = method.estimate(xyz, transforms.apply(T_TRUE, xyz), seed=0)
    assert answer.T_target_source is not None
    assert np.allclose(answer.T_target_source, np.eye(4))


def test_scale_is_raised_until_the_coarsest_points_are_few_enough(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    scaling = importlib.import_module("scaling")
    rng = np.random.default_rng(2)
    flat = rng.uniform((0.0, 0.0, 0.0), (200.0, 200.0, 0.5), (40_000, 3))
    assert scaling.fitted_scale([flat], 12.0, 0.2, 100_000) == 12.0
    scale = scaling.fitted_scale([flat, flat[:100]], 12.0, 0.2, 500)
    assert len(scaling.thinned(flat, 0.2 * scale)) <= 500 < len(scaling.thinned(flat, 0.2 * scale / 1.2))
    thin = scaling.thinned(flat, 5.0)
    assert np.abs(thin.mean(axis=0) - flat.mean(axis=0)).max() < 1.0


def test_normals_point_outward_from_the_air_and_from_the_street():
    rng = np.random.default_rng(4)
    plane = rng.uniform(size=(20_000, 2))
    ground = np.column_stack([60 * plane - 30, rng.normal(0, 0.01, len(plane))])
    inside = np.abs(ground[:, :2]).max(axis=1) < 10.0
    roof = ground[inside] + [0.0, 0.0, 8.0]
    # the wall of x = 10 alone, as from a scanner to the east of it
    wall = np.column_stack(
        [rng.normal(10.0, 0.01, 4000), rng.uniform(-10, 10, 4000), rng.uniform(0, 8, 4000)]
    )
    street = ground[ground[:, 0] > 10.0]
    for cloud in (np.vstack([ground[~inside], roof, wall]), np.vstack([street, wall])):
        found = normals.oriented_normals(cloud)
        assert np.allclose(np.linalg.norm(found, axis=1), 1.0)
        walls = found[-len(wall) :]
        middle = np.abs(wall[:, 1]) < 8.0
        assert np.mean(walls[middle & (wall[:, 2] > 1.0) & (wall[:, 2] < 7.0), 0] > 0.9) > 0.99
        assert np.mean(found[: -len(wall), 2] > 0.0) > 0.999
    assert np.array_equal(normals.oriented_normals(np.zeros((2, 3))), [[0.0, 0.0, 1.0]] * 2)


ENDINGS = """
import os, signal, subprocess, sys, threading
import numpy as np
what, result = int(sys.argv[1]), sys.argv[2]

def matrix(T):
    np.savetxt(result, T)

if what == 6:
    print("Cannot open display"); sys.stdout.flush()
    os.kill(os.getpid(), signal.SIGSEGV)
elif what == 1:
    print("the cause: file not found", file=sys.stderr)
    print("bye", file=sys.stderr)
    sys.exit(3)
elif what == 2:
    print("all went well")
elif what == 3:
    open(result, "wb").write(bytes(range(256)) * 4)
elif what == 4:
    matrix(np.full((4, 4), np.nan))
elif what == 5:
    matrix(np.diag([1.0, 1.0, -1.0, 1.0]))
elif what == 9:
    # what it complains of is no failure where it answers
    print("Warning: cannot find normals", file=sys.stderr)
    matrix(np.eye(4))
elif what == 10:
    os.kill(os.getpid(), signal.SIGKILL)
elif what == 11:
    # what it has started goes with it
    child = subprocess.Popen([sys.executable, "-c", "import threading; threading.Event().wait()"])
    print("child", child.pid, flush=True)
    threading.Event().wait()
elif what == 7:
    held = [bytearray(2**26) for _ in range(64)]
elif what == 8:
    {}["registration"]
elif what == 0:
    matrix(np.eye(4))
"""
TOLD = {
    0: "",
    1: "exit code 3: the cause: file not found",
    2: "exit code 0, but it wrote no result: all went well",
    3: "exit code 0, but no usable result (result.txt holds 0 numbers, not sixteen): it printed nothing",
    4: "exit code 0, but no usable result (not all of its numbers are finite): it printed nothing",
    5: "exit code 0, but no usable result (its determinant is -1: a mirror image, or no rotation at all)",
    6: "ended by SIGSEGV: Cannot open display",
    7: "exit code 1: MemoryError",
    8: "exit code 1: KeyError: 'registration'",
    9: "",
    10: "ended by SIGKILL, as the system does where memory runs out: it printed nothing",
    11: "stopped at the time limit of 2 s: child",
}


@pytest.fixture
def pair(tmp_path):
    folder = tmp_path / "data" / "pair"
    folder.mkdir(parents=True)
    xyz = programs.scattered(np.random.default_rng(1))
    for name in ("source", "target"):
        write_laz(folder / f"{name}.laz", ArrayCloud(xyz, None, name))
    (folder / "pair.json").write_text(
        json.dumps({"ground_truth": {"T_target_from_source": np.eye(4).tolist()}})
    )
    return folder


@pytest.mark.skipif(sys.platform != "linux", reason="signals and memory limits of Linux")
def test_every_end_is_told_in_the_runs(pair, tmp_path):
    (tmp_path / "program.py").write_text(ENDINGS)
    described = {
        "command": [sys.executable, "{here}/program.py", "{seed}", "{result}"],
        "format": "npy",
        "memory_limit_mib": 2000,
        "environment": {"OPENBLAS_NUM_THREADS": "1"},
    }
    (tmp_path / "method.json").write_text(json.dumps(described))
    method, out = f"external:file={tmp_path / 'method.json'}", tmp_path / "out"
    starts = max(TOLD)
    rows = run_protocol([pair], [method], out, starts=starts, ranges=StartRange(seed=0))
    write_results(rows, out, {})
    # that of the benchmark counts where it is the lower time limit
    late, seed = tmp_path / "late", StartRange(seed=starts)
    write_results(run_protocol([pair], [method], late, starts=1, ranges=seed, time_limit_s=2.0), late, {})
    texts = [(folder / "runs.csv").read_text().splitlines() for folder in (out, late)]
    lines = [line for text in texts for line in csv.DictReader(text)]
    assert len(lines) == len(TOLD)
    for what, line in enumerate(lines):
        assert line["reason"].startswith(TOLD[what])
        assert (line["reason"] == "") == (TOLD[what] == "")
        answered = TOLD[what] == ""
        # a run without an answer has no time
        assert (line["time_s"] != "") == answered
        assert (line.get("rotation_deg", "") != "") == answered
        assert (line["verdict"], line["false_accept"]) == ("unjudged", "False")
    assert "Traceback" in (out / lines[8]["printed"]).read_text()
    assert lines[0]["printed"] == ""
    assert (out / lines[9]["printed"]).read_text() == "Warning: cannot find normals\n"
    child = int((late / lines[-1]["printed"]).read_text().split()[1])
    state = Path("/proc") / str(child) / "stat"
    assert not state.exists() or state.read_text().split()[2] == "Z"


@pytest.mark.skipif(sys.platform != "linux", reason="resident memory is read from /proc")
def test_memory_of_all_that_a_command_starts_counts(tmp_path):
    half = "import threading; held = bytearray(b'x') * (150 * 2**20); threading.Event().wait(60)"
    both = f"import subprocess, sys; run = [sys.executable, '-c', {half!r}]; subprocess.Popen(run)\n{half}"
    ended = process.run_command(
        [sys.executable, "-c", both], tmp_path, environment={}, time_limit_s=60.0, memory_limit_mib=256
    )
    assert ended.failure.startswith("stopped at the memory limit of 256 MiB")


def test_program_that_is_not_there_is_named(tmp_path):
    ended = process.run_command(["no-such-program"], tmp_path, environment={}, time_limit_s=1.0)
    assert ended.failure == "cannot run no-such-program: there is no such program"


TEASER = """
import os, sys
import numpy as np
from types import SimpleNamespace as Space
from solving import solved

class RobustRegistrationSolver:
    INLIER_SELECTION_MODE = Space(PMC_EXACT=0)
    INLIER_GRAPH_FORMULATION = Space(CHAIN=0)
    ROTATION_ESTIMATION_ALGORITHM = Space(GNC_TLS=0)

    class Params:
        max_clique_time_limit = 3600.0

    def __init__(self, params):
        assert params.max_clique_time_limit < 600 and params.noise_bound == 2 and not params.estimate_scaling
        self.limit = params.max_clique_time_limit

    def solve(self, src, dst):
        assert src.shape == dst.shape and src.shape[0] == 3
        if self.limit == 1:
            self.solution.valid
        if self.limit == 2:
            print("terminate called: std::bad_alloc", file=sys.stderr, flush=True)
            os.abort()
        # uninitialised where no clique is found
        self.T = solved(src.T, dst.T) if self.limit != 3 else np.full((4, 4), 7e42)

    solution = Space()

    def getSolution(self):
        return Space(rotation=self.T[:3, :3], translation=self.T[:3, 3], scale=1.0)

    def getInlierMaxClique(self):
        return [0] if self.limit == 3 else list(range(50))

    getTranslationInliers = getInlierMaxClique
"""


@pytest.fixture
def teaser(tmp_path, monkeypatch):
    try:
        import_open3d()
    except MissingPartError as error:
        pytest.skip(str(error))
    programs.write(tmp_path / "modules", {"teaserpp_python.py": TEASER, "solving.py": programs.SOLVING})
    monkeypatch.delitem(sys.modules, "teaserpp_python", raising=False)
    monkeypatch.syspath_prepend(str(tmp_path / "modules"))


def test_teaser_is_right_and_refuses_where_nothing_agrees(teaser):
    rng = np.random.default_rng(5)
    xyz = programs.scattered(rng)

    class Kept(Features):
        def __init__(self, points):
            self.__dict__["points"] = points

        @property
        def xyz(self):
            return self.__dict__["points"]

    matches = np.stack([np.arange(len(xyz))] * 2, axis=1)
    moved = transforms.apply(T_TRUE, xyz)
    answer = FpfhTeaser(voxel=2).solve(Kept(xyz), Kept(moved), matches, 0)
    assert answer.T_target_source is not None
    assert np.allclose(answer.T_target_source, T_TRUE)
    assert answer.details["clique"] == 50
    none = FpfhTeaser(voxel=2, clique_limit_s=3).solve(Kept(xyz), Kept(moved), matches, 0)
    assert (none.T_target_source, none.verdict) == (None, "refused")
    assert "no two" in none.reason


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="signals of Linux")
def test_baseline_in_process_that_raises_or_crashes_is_told(teaser, pair, tmp_path, monkeypatch):
    from helpers_scene import houses

    for seed, name in enumerate(("source", "target")):
        xyz = houses(np.random.default_rng(seed), 8_000)
        write_laz(pair / f"{name}.laz", ArrayCloud(xyz, None, name))
    tried = [f"fpfh-teaser:voxel=2,icp=no,clique_limit_s={limit}" for limit in (1, 2, 3)]
    rows = run_protocol([pair], tried, tmp_path / "out", starts=1, ranges=StartRange(seed=0))
    reasons = {row["method"]: row["reason"] for row in rows}
    assert reasons[tried[0]].startswith("AttributeError: ")
    assert reasons[tried[1]] == "the process was lost, ended by SIGABRT: terminate called: std::bad_alloc"
    assert reasons[tried[2]] == "no two of its matches agree"
    # a refusal is an answer, and took its time
    assert [row["time_s"] is not None for row in rows] == [False, False, True]
    assert "Traceback" in (tmp_path / "out" / rows[0]["printed"]).read_text()


def test_telling_lines():
    told = process.telling_lines
    assert told("") == ""
    assert told("one\n\ntwo\n") == "two"
    assert told("\x1b[1;33m[Warning] large\nset it\x1b[0m\n\x1b[0m") == "set it"
    assert told("step 1\r\nerror: too few planes\nregistration failed\nlast") == (
        "error: too few planes; registration failed"
    )
    assert told("reading\ntwo few planes\nregistration failed\n") == "two few planes; registration failed"
    many = "\n".join(f"cannot do {k}" for k in range(9))
    assert told(many) == "cannot do 0; cannot do 1; cannot do 8"
    trace = (
        "Traceback (most recent call last):\n  File 'x'\nlib.CustomError: it broke\nException ignored in x"
    )
    assert told(trace) == "lib.CustomError: it broke"
    assert told("working\nno errors reported here") == "no errors reported here"


def test_much_that_is_printed_loses_its_middle(tmp_path):
    path = tmp_path / "output.txt"
    path.write_bytes(b"first" + b"x" * (2 * process.PRINTED_LIMIT) + b"last")
    kept = process.kept_of(path)
    assert kept.startswith("first")
    assert kept.endswith("last")
    assert len(kept) < process.PRINTED_LIMIT + 100
    assert "bytes left out" in kept


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 2\n", "last row"),
        ("1 0 0 0\n0 1 0 0\n0 0 1 inf\n0 0 0 1\n", "finite"),
        ("1 0 0 0\n0 2 0 0\n0 0 1 0\n0 0 0 1\n", "right angles"),
        ("0 0 0 0\n0 0 0 0\n0 0 0 0\n0 0 0 1\n", "no rotation"),
        ("x" * (2**20 + 1), "larger than"),
    ],
)
def test_what_is_no_similarity_is_no_result(tmp_path, text, message):
    path = tmp_path / "result.txt"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        external.read_matrix(path)
