# SPDX-License-Identifier: Apache-2.0
"""What a program of ours has set up in its process, seen from a process that the caller's settings do not reach."""

import os
import subprocess
import sys

WATCH_TORCH = """
import importlib.abc, os, sys

class Watch(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name == "torch":
            print("torch:", os.environ.get("GOMP_SPINCOUNT"))

sys.meta_path.insert(0, Watch())
"""
"""Tells how OpenMP's threads will wait, once something after it loads torch, which reads that once."""


def output_of(script: str, **environment: str) -> str:
    """What a script prints, without the caller's settings of OpenMP and malloc."""
    without = {name: value for name, value in os.environ.items() if not name.startswith(("GOMP", "OMP", "MALLOC"))}
    command = [sys.executable, "-c", script]
    return subprocess.run(command, env=without | environment, check=True, capture_output=True, text=True).stdout
