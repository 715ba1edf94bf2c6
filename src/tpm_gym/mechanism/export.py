"""Files of a robot for other tools: URDF with its loop closures, and MJCF.

Run ``python -m tpm_gym.mechanism.export FOLDER`` to write the files of the paper's robot and of the
Delta.
"""

import sys
from pathlib import Path

from tpm_gym.mechanism.delta.machine import DELTA
from tpm_gym.mechanism.machine import Machine
from tpm_gym.mechanism.mjcf import mjcf_text
from tpm_gym.mechanism.tpm import PAPER_TPM
from tpm_gym.mechanism.urdf import loops_text, urdf_text

SHIPPED = (PAPER_TPM, DELTA)


def write(folder: Path, machine: Machine = PAPER_TPM) -> list[Path]:
    """Write all files of a robot into a folder, which is created if missing; return the paths.

    The names of the files begin with the name of the robot's mechanism.
    """
    texts = {
        ".urdf": urdf_text(machine.mechanism, closure_frames=True),
        ".loops.yaml": loops_text(machine.mechanism),
        ".xml": mjcf_text(machine),
    }
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for ending, text in texts.items():
        written.append(folder / f"{machine.mechanism.name}{ending}")
        written[-1].write_text(text, encoding="utf-8", newline="\n")
    return written


if __name__ == "__main__":
    for shipped in SHIPPED:
        print(*write(Path(sys.argv[1]), shipped), sep="\n")
