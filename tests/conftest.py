"""Runs of the algorithm scripts inside the test's own process."""

import runpy
import signal
import sys
import threading
import time

import pytest
import torch
from script_runs import ROOT

import crane_runs

torch.set_num_threads(1)  # the batches are too small for more


@pytest.fixture
def run_here(tmp_path, monkeypatch):
    """run_here(algorithm, *arguments, cwd=tmp_path) gives the variables that the script left.

    As `script_runs.run`, without the seconds that a new process takes to import torch.
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
        threads, handlers = torch.get_num_threads(), {}
        for signum in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            # where the tests run in the background, some are ignored, and scripts respect that
            handlers[signum] = signal.signal(signum, signal.SIG_DFL)
        try:
            return runpy.run_path(file, run_name="__main__")
        finally:
            torch.set_num_threads(threads)
            while crane_runs.LOCKS:  # which a script holds until its process ends
                crane_runs.LOCKS.pop().release()
            for signum, handler in handlers.items():
                signal.signal(signum, handler)

    return run
