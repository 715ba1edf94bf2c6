"""Run the shell steps of a workflow's job on this machine.

    python .github/run_steps.py tests.yml wheel os=ubuntu-latest python=3.11

Actions (`uses:`) are left out: the checkout is the current folder, Python the one that runs this.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import yaml


def main(file: str, name: str, *values: str) -> None:
    """Run the steps of the job ``name``, with ``key=value`` for its matrix."""
    job = yaml.safe_load((Path(__file__).parent / "workflows" / file).read_text())["jobs"][name]
    matrix = dict(value.split("=", 1) for value in values)
    programs = Path(sys.executable).parent
    variables = {"PATH": f"{programs}{os.pathsep}{os.environ['PATH']}", **job.get("env", {})}
    for step in job["steps"]:
        if "run" not in step:
            continue
        command = step["run"]
        for key, value in matrix.items():
            command = command.replace("${{ matrix." + key + " }}", value)
        print(f"+ {command}", flush=True)
        subprocess.run(["bash", "-ec", command], env={**os.environ, **variables}, check=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
