"""Files of a robot for other tools: URDF with its loop closures, and MJCF.

Run ``python -m tpm_gym.mechanism.export FOLDER`` to write the files of the paper's robot.
"""

import sys
from pathlib import Path

from tpm_gym.mechanism.machine import Machine
from tpm_gym.mechanism.mjcf import mjcf_text
from tpm_gym.mechanism.tpm import PAPER_TPM
from tpm_gym.mechanism.urdf import LOOPS_FILE, loops_text, urdf_text

URDF_FILE, MJCF_FILE = "tpm.urdf", "tpm.xml"


def write(folder: Path, machine: Machine = PAPER_TPM) -> list[Path]:
    """Write all files of a robot into a folder, which is created if missing; return the paths."""
    texts = {
        URDF_FILE: urdf_text(machine.mechanism, closure_frames=True),
        LOOPS_FILE: loops_text(machine.mechanism),
        MJCF_FILE: mjcf_text(machine),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")
    return [folder / name for name in texts]


if __name__ == "__main__":
    print(*write(Path(sys.argv[1])), sep="\n")
