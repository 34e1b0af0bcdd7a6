"""The program, started anew as a person does."""

from __future__ import annotations

import os
import subprocess
import sys

PROGRAM = [sys.executable, "-P", "-m", "grr_torch.cli.main"]


def run(*arguments, cwd):
    environment = {**os.environ, "COLUMNS": "200"}
    words = [str(argument) for argument in arguments]
    return subprocess.run([*PROGRAM, *words], cwd=cwd, capture_output=True, text=True, env=environment, check=False)
