"""Runs of the algorithm scripts inside the test's own process."""

import runpy
import signal
import sys
import threading
import time
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[1]
torch.set_num_threads(1)  # the batches are too small for more


@pytest.fixture
def run_here(tmp_path, monkeypatch):
    """run_here(algorithm, *arguments, cwd=tmp_path) gives the variables that the script left.

    It saves the seconds that a new process takes to import torch.
    """
    for module in (sys, threading):
        monkeypatch.setattr(module, "excepthook", module.excepthook)  # what scripts set ends here

    def run(algorithm, *arguments, cwd=tmp_path):
        if "--resume" in arguments:
            # TensorBoard sorts a run's files by second, then by a counter as text: 10 before 9
            time.sleep(1.1)
        monkeypatch.chdir(cwd)
        file = str(ROOT / f"{algorithm}_crane.py")
        monkeypatch.setattr(sys, "argv", [file, *map(str, arguments)])
        monkeypatch.setattr(sys, "path", [*sys.path])  # scripts add the current folder
        threads, handlers = torch.get_num_threads(), {}
        for name in {"SIGINT", "SIGTERM", "SIGHUP"} & set(dir(signal)):
            # where the tests run in the background, some are ignored, and scripts respect that
            number = getattr(signal, name)
            handlers[number] = signal.signal(number, signal.SIG_DFL)
        try:
            return runpy.run_path(file, run_name="__main__")
        finally:
            torch.set_num_threads(threads)
            for number, handler in handlers.items():
                signal.signal(number, handler)

    return run
