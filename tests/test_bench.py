"""`python -m apex_lab.bench`: what it writes, what it refuses, and that the step it measures never waits or breaks."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch.autograd.profiler_util import Interval, Kernel
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from apex_lab import bench
from apex_lab.base.errors import UserError
from apex_lab.benchmark import arithmetic, child, compare
from apex_lab.benchmark import printed as report
from apex_lab.benchmark.arithmetic import flops_by_part, processor_seconds, shares
from apex_lab.benchmark.measure import Case, measure
from apex_lab.benchmark.profile import REST, _by_kernels, seconds_by_part
from apex_lab.benchmark.work import Workload
from apex_lab.config.job import check_job
from apex_lab.training import update as updates
from apex_lab.training.optimizers import Muon
from tests.conftest import TINY, Ended, compose_job
from tests.models.apex.small import everything
from tests.training.replayed import Replayed

APEX = ("model=apex", "data=p2d", "scale=smoke", "trainer=cpu")
HERE = torch.device("cpu")


def workload(*words: str, device: torch.device = HERE) -> Workload:
    return Workload(compose_job(*APEX[:3], *words).config, device, 1, 2)


@contextlib.contextmanager
def in_the_same_process(asked: compare.Comparison, name: str) -> Iterator[Callable[[], tuple[float, float]]]:
    """As `compare.own_process`, without the seconds that a process takes to begin."""
    with torch.random.fork_rng(devices=[]):
        yield compare.timed_step(compare.workload(asked, name))


def in_this_process(work: Callable[[Any], Any], asked: Any) -> Any:
    return work(asked)


class HostSynchronisation(Exception):
    """An operation that has to wait for the device's result."""


class _Operations(TorchDispatchMode):
    """Raises for every operation whose result the host must see before it can go on."""

    WAITS = ("_local_scalar_dense", "nonzero", "is_nonzero", "item", "equal", "masked_select", "_unique", "_unique2")

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        if name in self.WAITS or (name in ("index", "index_put", "index_put_") and self._boolean(args[1])):
            raise HostSynchronisation(name)
        return func(*args, **(kwargs or {}))

    @staticmethod
    def _boolean(indices: Any) -> bool:
        return any(index is not None and index.dtype in (torch.bool, torch.uint8) for index in indices)


class _Calls(TorchFunctionMode):
    """Raises for every call that on a GPU would copy between host and device."""

    COPIES = ("tolist", "numpy", "cpu", "__array__", "tensor", "as_tensor", "new_tensor", "from_numpy")

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if getattr(func, "__name__", "") in self.COPIES:
            raise HostSynchronisation(func.__name__)
        return func(*args, **(kwargs or {}))


@contextlib.contextmanager
def no_synchronisation() -> Iterator[None]:
    with _Calls(), _Operations():
        yield


@pytest.mark.parametrize("words", [(), ("+ablation=image_stn",), ("+ablation=gaussian_scalor_norm",)], ids=" ".join)
def test_nothing_in_the_training_step_waits_for_the_device(words: tuple[str, ...]) -> None:
    work = workload(*words)
    step = work.step(training=True)
    step()
    before = [p.detach().clone() for p in work.model.parameters()]
    assert work.optimizer is not None
    # without Adam, which reads its step counts; they lie on the host, so that waits for nothing on a GPU
    with everything(), no_synchronisation():
        work.update(work.video, work.optimizer, update=lambda: None)
    work.optimizer.step()
    assert any(not torch.equal(a, b) for a, b in zip(before, work.model.parameters(), strict=True))


@pytest.mark.parametrize("captured", [False, True])
def test_nothing_in_an_update_by_muon_waits_for_the_device(captured: bool) -> None:
    model = torch.nn.Sequential(torch.nn.Conv2d(3, 8, 3), torch.nn.Flatten(), torch.nn.Linear(32, 2))
    optimizer = updates.remember_rates(Muon(model.parameters()), captured)
    model(torch.rand(5, 3, 4, 4)).square().sum().backward()
    optimizer.step()
    before = [p.detach().clone() for p in model.parameters()]
    with no_synchronisation():
        optimizer.step()
    assert all(not torch.equal(a, b) for a, b in zip(before, model.parameters(), strict=True))


@pytest.mark.parametrize(
    "waits",
    [
        lambda x: x.sum().item(),
        lambda x: bool(x.sum() > 0),
        lambda x: x[x > 0],
        lambda x: x.nonzero(),
        lambda x: x.sum().tolist(),
        lambda x: x.new_tensor([1.0]),
        lambda x: torch.tensor(3.0),
    ],
)
def test_the_watch_over_synchronisation_sees_it(waits: Callable[[torch.Tensor], object]) -> None:
    with pytest.raises(HostSynchronisation), no_synchronisation():
        waits(torch.ones(3))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_the_training_step_never_waits_on_a_gpu() -> None:
    work = workload("trainer=gpu", device=torch.device("cuda"))
    step = work.step(training=True)
    for _ in range(2):
        step()
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        step()
    finally:
        torch.cuda.set_sync_debug_mode("default")


ONE_GRAPH = """
import json, sys
import torch
from apex_lab.benchmark.work import Workload
from apex_lab.config.job import check_job
from apex_lab.nn.noise import RankNoise
from apex_lab.scene import Context
work = Workload(check_job(json.load(sys.stdin), {}, needs_recipe=False).config, torch.device("cpu"), 1, 2)
work.model.train()
forward = torch.compile(work.model.forward, backend="eager", fullgraph=True)  # raises where a graph would break
context = Context(work.update.schedules.tensors(), RankNoise(1, 0, 1))
loss = work.update.objective(forward(work.video.float() / 255, context).terms)
loss.backward()
assert loss.isfinite()
"""


@pytest.mark.slow  # nearly all that breaks a graph also waits for the device, which is tested above
@pytest.mark.parametrize("words", [(), ("+ablation=image_stn",), ("+ablation=gaussian_scalor_norm",)], ids=" ".join)
def test_the_training_step_is_one_graph(words: tuple[str, ...], tmp_path: Path) -> None:
    # In a process of its own, because the type checks of the tests cannot be compiled (pytorch #122093).
    raw = json.dumps(compose_job(*APEX[:3], *words).raw)
    command = [sys.executable, "-c", ONE_GRAPH]
    process = subprocess.run(command, input=raw, capture_output=True, text=True, cwd=tmp_path)
    assert process.returncode == 0, process.stderr


INSIDE = {"forward", "encoder", "discovery", "loop over time", "propagation", "rendering", "likelihood", REST}
"""Parts of a step of APEX that are there in inference too."""


def test_the_parts_are_all_there_and_add_up() -> None:
    work = workload()
    for training in (True, False):
        step = work.step(training)
        step()
        inside: list[float] = []

        def watched(step: Callable[[], object] = step, inside: list[float] = inside) -> None:
            began = time.perf_counter()
            step()
            inside.append(time.perf_counter() - began)

        began = time.perf_counter()
        seconds = seconds_by_part(watched, HERE)
        passed = time.perf_counter() - began
        assert set(seconds) == (INSIDE | {"backward", "update"} if training else INSIDE - {"forward"})
        assert all(value > 0 for value in seconds.values())
        assert 0.99 * inside[0] < sum(seconds.values()) <= passed  # the rest is setting up the profiler


def test_a_part_s_time_is_without_the_parts_inside_it() -> None:
    def step() -> None:
        with torch.profiler.record_function("outer"):
            time.sleep(0.1)
            with torch.profiler.record_function("inner"):
                time.sleep(0.2)
            with torch.profiler.record_function("inner"):
                time.sleep(0.1)
        time.sleep(0.2)

    seconds = seconds_by_part(step, HERE)
    assert seconds.keys() == {"outer", "inner", REST}
    for name, slept in (("outer", 0.1), ("inner", 0.3), (REST, 0.2)):
        assert slept <= seconds[name] < slept + 0.1, name


def test_on_a_gpu_a_part_s_time_is_that_of_its_kernels() -> None:
    """By events as PyTorch's profiler gives them, in microseconds: a range of the host's has a copy on the GPU."""
    on_host, on_gpu = torch.autograd.DeviceType.CPU, torch.autograd.DeviceType.CUDA

    def event(
        name: str, start: float, end: float, thread: int = 1, where: Any = on_host, **kernels: float
    ) -> SimpleNamespace:
        return SimpleNamespace(
            name=name,
            is_user_annotation=name in {"step", "forward", "encoder", "backward"},
            device_type=where,
            thread=thread,
            time_range=Interval(start, end),
            kernels=[Kernel(kernel, 0, duration) for kernel, duration in kernels.items()],
        )

    events = [
        event("step", 0, 100, step=900),  # the copies of ranges are listed among the kernels of the ranges
        event("forward", 10, 40, forward=300),
        event("encoder", 12, 20),
        event("backward", 50, 90),
        event("aten::conv", 13, 14, gemm=100),
        event("aten::add", 30, 31, elementwise=20, copy=3),
        event("aten::conv_backward", 60, 61, thread=2, gemm=200),  # autograd's own thread
        event("aten::zeros", 95, 96, fill=7),
        event("aten::before", -5, -4, fill=1000),
        event("forward", 15, 400, where=on_gpu),
    ]
    expected = {"forward": 23e-6, "encoder": 100e-6, "backward": 200e-6, REST: 7e-6}
    assert _by_kernels(events) == pytest.approx(expected)


def test_writes_a_file_with_every_row(
    command: Callable[..., Ended], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "in_child", in_this_process)
    monkeypatch.setattr(compare, "own_process", in_the_same_process)
    ended = command(
        "bench", *APEX, "trainer.compile=false", "bench.repeats=1", "data.frames=2", "bench.output=out/speed.json"
    )
    assert ended.code == 0, ended.err
    told = json.loads((tmp_path / "out" / "speed.json").read_text())
    assert [(row["mode"], row["what"]) for row in told["rows"]] == [("eager", "training step"), ("eager", "inference")]
    for row in told["rows"]:
        assert row["frames_per_second"] * row["seconds"] == pytest.approx(2 * 2)
        assert row["peak_memory_gib"] > 0.05
        assert 0.2 * row["seconds"] < sum(row["parts"].values()) < 5 * row["seconds"]
    assert told["whole_batch"]["batch_size"] == 2
    [compared] = told["comparisons"]
    assert compared["models"]["model"]["model_trains_times_as_many"] == 1
    assert set(compared["models"]) == {"model", "straightforward", "straightforward, renders as many"}
    assert all(each["model_trains_times_as_many"] > 0 for each in compared["models"].values())
    assert told["versions"]["torch"] == importlib.metadata.version("torch")
    assert told["hardware"]["threads"] == 1
    assert "peak memory" in ended.out
    assert "times as many frames/s" in ended.out
    assert list((tmp_path / "out").iterdir()) == [tmp_path / "out" / "speed.json"]


def test_any_model_can_be_measured(
    command: Callable[..., Ended], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "in_child", in_this_process)
    monkeypatch.setattr(compare, "own_process", in_the_same_process)
    words = ("trainer=cpu", "trainer.compile=false", "bench.repeats=1")
    assert command("bench", *TINY, *words).code == 0
    assert command("bench", "model=color_clusters", "scale=smoke", *words).code == 0
    told = [json.loads(path.read_text()) for path in (tmp_path / "outputs" / "bench").iterdir()]
    assert sorted(len(each["rows"]) for each in told) == [1, 2]
    assert all(each["comparisons"] == [] for each in told)


def stop(*_: object) -> None:
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(10)  # the handler raises


def test_stopped_it_does_not_say_that_it_resumes(
    command: Callable[..., Ended], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "in_child", stop)
    for words in ((), ("seed=0,1", "-m")):
        ended = command("bench", *TINY, "trainer=cpu", *words)
        assert ended.code == 128 + signal.SIGTERM
        assert "Stopped by SIGTERM; the same command begins from the start." in ended.err
        assert "resumes" not in ended.out + ended.err


REFUSED = {
    "bench.repeats=0": "bench.repeats = 0 is wrong: input should be greater than or equal to 1.",
    "+bench.repeat=3": "Unknown key bench.repeat = 3; did you mean 'repeats'?",
    "bench.modes=[fast]": "bench.modes.0 = 'fast' is wrong: input should be 'eager', 'compiled', 'cuda "
    "graph' or 'compiled cuda graph'.",
    "bench.modes=[cuda graph]": "bench.modes holds 'cuda graph', but nothing is measured on a GPU: leave it out.",
    "bench.modes=[compiled cuda graph]": "bench.modes holds 'compiled cuda graph', but nothing is measured on a GPU: "
    "leave it out.",
    "bench=3": "bench = 3 is wrong: give bench.repeats=... and the like.",
    "bench.output=/dev/null": "bench.output = '/dev/null' is a device or the like: name a file.",
    "bench.output=/proc/foo": "/proc/foo cannot be written (No such file or directory): choose another folder or its "
    "permissions.",
    "bench.output=/dev/null/foo/bar": "/dev/null/foo/bar cannot be written (Not a directory): choose another folder or",
    "paths.outputs=/proc/foo": "_seed_0.json cannot be written (No such file or directory): choose another folder or",
    "bench.output=.": "bench.output = '.' is a folder: name a file.",
    "model=oracle": "model=oracle reads the ground truth: choose a model that looks at the video.",
    "trainer.max_step=3": "Unknown key trainer.max_step = 3; did you mean 'trainer.max_steps'?",
    "data.frames=0": "data.frames = 0 is wrong: input should be greater than 0.",
    "scale=cpuu": "did you mean 'cpu'?",
}


@pytest.mark.parametrize("word", REFUSED)
def test_refuses_in_one_sentence(word: str, command: Callable[..., Ended], tmp_path: Path) -> None:
    ended = command("bench", "scale=smoke", "trainer=cpu", word)
    assert ended.code == 2
    assert REFUSED[word] in ended.err
    assert len(ended.err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_what_follows_its_schedule_is_not_measured_as_a_graph() -> None:
    predictions = "+schedule.predictions={_target_: apex_lab.training.schedules.Constant, value: 1.0}"
    job = compose_job("model=op3", "data=sprites", "scale=smoke", "model.schedule=curriculum", predictions)
    job = check_job(job.raw, job.choices)
    keys = {"modes": None, "warmup": 1, "repeats": 1, "memory": False, "compare": False, "output": None}
    keys |= {"cpu_videos": None, "cpu_frames": None, "cpu_compiled_frames": None}
    raw = {**job.raw, "bench": keys}
    assert bench.check_bench(raw, job.choices, ()).modes == ("eager", "compiled")
    raw["bench"] = {**keys, "modes": ["cuda graph"]}
    with pytest.raises(UserError, match=r"bench\.modes holds 'cuda graph', and this model's steps follow its schedule"):
        bench.check_bench(raw, job.choices, ())


def test_composes_what_train_composes(command: Callable[..., Ended]) -> None:
    words = ("scale=cpu", "+ablation=image_stn", "seed=3", "--cfg", "job", "--resolve")
    train, measured = (command(entry, *words).out for entry in ("train", "bench"))
    kept = [line for line in measured.splitlines() if line in train.splitlines()]
    # a benchmark has random weights
    assert sorted([*kept, "init_from: null"]) == sorted(train.splitlines())


def test_what_cannot_be_compiled_is_said_in_its_row(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise torch._dynamo.exc.BackendCompilerFailed(None, RuntimeError("No working C++ compiler"), None)

    monkeypatch.setattr(Workload, "train", refuse)
    row = measure(Case(compose_job(*APEX).config, "cpu", "compiled", True, 1, 2, 1, 1))
    assert "No working C++ compiler" in row["unavailable"]
    assert report.line(row).startswith("cpu, compiled, training step: cannot be compiled here: ")


def test_what_does_not_fit_a_gpu_is_said_in_its_row(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise torch.OutOfMemoryError

    monkeypatch.setattr(Workload, "train", refuse)
    row = measure(Case(compose_job(*APEX).config, "cpu", "eager", True, 1, 2, 1, 1))
    assert report.line(row) == "cpu, eager, training step: the GPU's memory does not hold it"
    assert report.tables([row]) == []


def test_the_measurement_of_a_graph_begins_after_its_capture(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the graph of tests/training/replayed.py; rows name how matrices are multiplied on a GPU."""
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    monkeypatch.setattr(updates, "Captured", Replayed)
    steps: list[bool] = []
    real = Workload.train

    def noted(work: Workload) -> None:
        steps.append(work.update._graph is not None)
        real(work)

    monkeypatch.setattr(Workload, "train", noted)
    row = measure(Case(compose_job(*APEX).config, "cpu", "cuda graph", True, 1, 2, 1, 2))
    assert steps == [False] * 4 + [True] * 3  # the fourth captures
    assert "parts" not in row
    assert "graph_breaks" not in row
    assert report.name(row) == "cpu, cuda graph, training step"
    row = {**row, "precision": "bf16-mixed", "matmul_precision": "high"}
    assert report.name(row) == "cpu, cuda graph, bf16, matmul high, training step"


def kill_this_process(_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def refuse_in_child(_: object) -> None:
    raise UserError("No.")


@pytest.mark.parametrize("model", ["gswm", "op3", "scalor", "slot_attention", "space"])
def test_every_twin_takes_the_recipe_s_optimiser(model: str) -> None:
    """Also where the recipe has several, each for parameters with names of its own."""
    job = compose_job(f"model={model}", "scale=paper")
    config = check_job(job.raw, job.choices).config
    work = compare.workload(compare.Comparison(config, "cpu", 1, 1, 0, 1), "straightforward")
    assert work.optimizer is not None
    found = [weight for group in work.optimizer.param_groups for weight in group["params"]]
    assert {id(weight) for weight in found} == {id(weight) for weight in work.model.parameters()}


@pytest.mark.slow
def test_a_child_that_dies_is_told() -> None:
    with pytest.raises(UserError, match=r"ended by SIGKILL, as happens when memory runs out: lower clips\.batch_size"):
        child.in_child(kill_this_process, None)
    with pytest.raises(UserError, match=r"^No\.$"):
        child.in_child(refuse_in_child, None)


@pytest.mark.slow
def test_a_model_steps_in_its_own_process_and_its_death_is_told() -> None:
    job = compose_job(*APEX)
    asked = compare.Comparison(check_job(job.raw, job.choices).config, "cpu", 1, 2, 0, 1)
    with compare.own_process(asked, "straightforward") as step:
        passed, _ = step()
        assert 0 < passed < 60
        [worker] = multiprocessing.active_children()
        assert worker.pid is not None
        os.kill(worker.pid, signal.SIGKILL)
        with pytest.raises(
            UserError,
            match="measurement of straightforward was ended by SIGKILL, as happens when memory runs out: lower",
        ):
            step()
    assert not multiprocessing.active_children()


@pytest.mark.slow
def test_the_compiled_step_is_measured_in_a_process_of_its_own() -> None:
    job = compose_job(*APEX)
    row = child.in_child(measure, Case(check_job(job.raw, job.choices).config, "cpu", "compiled", True, 1, 2, 1, 1))
    assert row["unavailable"] is None
    assert row["graph_breaks"] == 0
    assert row["graphs"] == 1


def test_flops_are_counted_by_part_and_backward_and_without_a_graph() -> None:
    x, convolution = torch.rand(2, 3, 8, 8), torch.nn.Conv2d(3, 5, 3, padding=1)
    linear = torch.nn.Linear(6, 7)
    of_image, of_rows = 2 * 2 * 5 * 3 * 9 * 64, 2 * 4 * 6 * 7

    def step() -> None:
        with torch.profiler.record_function("outer"):
            with torch.profiler.record_function("inner"):
                found = convolution(x)
            time.sleep(0.05)
            with torch.no_grad():
                linear(torch.rand(4, 6))
        found.sum().backward()

    assert flops_by_part(step) == {"outer": of_rows, "inner": of_image, REST: of_image}


def test_the_processors_seconds_are_split_by_part_and_nothing_stays_patched() -> None:
    def busy(seconds: float) -> None:
        end = time.process_time() + seconds
        while time.process_time() < end:
            pass

    def step() -> None:
        with torch.profiler.record_function("outer"):
            busy(0.02)
            with torch.profiler.record_function("inner"):
                busy(0.04)
            time.sleep(0.05)  # waiting is no work
        with torch.profiler.record_function("outer"):
            busy(0.01)

    ways = torch.profiler.record_function.__enter__, torch.profiler.record_function.__exit__
    found = processor_seconds(step)
    assert found.keys() == {"outer", "inner", REST}
    assert found == {
        "outer": pytest.approx(0.03, abs=0.01),
        "inner": pytest.approx(0.04, abs=0.01),
        REST: pytest.approx(0, abs=0.01),
    }
    with pytest.raises(ZeroDivisionError):
        processor_seconds(lambda: 1 / 0)
    assert ways == (torch.profiler.record_function.__enter__, torch.profiler.record_function.__exit__)


def test_a_matrix_product_runs_at_its_own_rate() -> None:
    square = torch.rand(1024, 1024)
    found = shares(lambda: square @ square, HERE, {})
    assert found["flops"] == {REST: 2 * 1024**3}
    assert 0.3 < found["share"] < 1.5


def test_the_step_that_is_counted_is_the_step_that_is_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a workload that does more at every step, and by APEX, which discovers in frames that it draws."""

    class Growing:
        made = 0

        @contextlib.contextmanager
        def rewound(self) -> Iterator[None]:
            before = self.made
            yield
            self.made = before

        def step(self) -> None:
            self.made += 1
            with torch.profiler.record_function("growing"):
                for _ in range(self.made):
                    torch.ones(4, 4) @ torch.ones(4, 4)

    timed: list[int] = []

    def counted_again(step: Callable[[], object]) -> dict[str, float]:
        flops = flops_by_part(step)
        timed.append(sum(flops.values()))
        return {name: work / 1e9 for name, work in flops.items()}

    monkeypatch.setattr(arithmetic, "processor_seconds", counted_again)
    growing, work = (
        Growing(),
        workload("+schedule.discover={_target_: apex_lab.training.schedules.Constant, value: 0.5}"),
    )
    apex = work.step(training=True)
    for rewound, step in ((growing.rewound, growing.step), *[(work.rewound, apex)] * 4):
        found = shares(step, HERE, {}, rewound)
        assert sum(found["flops"].values()) == timed[-1]
        assert all(rate == pytest.approx(1e9) for name, rate in found["rates"].items() if found["flops"][name])
    assert growing.made == 1
    assert len(set(timed[1:])) > 1  # other steps discover in other frames


def test_a_step_taken_back_leaves_number_and_weights() -> None:
    work = workload()
    number, before = work.update.step, [p.detach().clone() for p in work.model.parameters()]
    with work.rewound():
        work.train()
        assert work.update.step == number + 1
        assert any(not torch.equal(a, b) for a, b in zip(before, work.model.parameters(), strict=True))
    assert work.update.step == number
    assert all(torch.equal(a, b) for a, b in zip(before, work.model.parameters(), strict=True))


def test_a_line_of_the_table_can_be_recomputed() -> None:
    row = measure(Case(compose_job(*APEX).config, "cpu", "eager", True, 1, 2, 1, 1))
    *_, table = report.tables([row])
    _, *lines, rate = table.splitlines()
    [of_product] = re.findall(r"[\d.]+$", rate)
    assert {re.split(" {2,}", line)[0] for line in lines} == {*row["arithmetic"]["flops"], "all"}
    for line in lines:
        found = re.search(r"(\S+) / (\S+) = (\S+), (\S+)%$", line)
        assert found is not None, line
        work, seconds, reached, share = map(float, found.groups())
        assert work / seconds == pytest.approx(reached, rel=2e-3)
        assert share / 100 * float(of_product) == pytest.approx(reached, abs=0.0006 * float(of_product))


QUIET = """
import time
import torch
from apex_lab.benchmark.profile import seconds_by_part
seconds_by_part(lambda: time.sleep(0), torch.device("cpu"))
"""


@pytest.mark.slow
def test_the_profiler_tells_nothing_of_itself(tmp_path: Path) -> None:
    process = subprocess.run([sys.executable, "-c", QUIET], capture_output=True, text=True, cwd=tmp_path)
    assert (process.returncode, process.stdout, process.stderr) == (0, "", "")
