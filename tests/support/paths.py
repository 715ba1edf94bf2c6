"""Places in the checkout, and how files are read."""

import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
SUPPORT = ROOT / "tests" / "support"


def read_strict(path: Path) -> dict[str, Any]:
    """Read JSON as a strict reader does: NaN and infinities are errors."""

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    content = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    assert isinstance(content, dict)
    return content
