"""`run.json`: what a run came to, for programs to read."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np


def write_run_json(path: Path, facts: Mapping[str, Any]) -> None:
    """Write what is known of a run as strict JSON.

    Args:
        path: file to write.
        facts: verdict, reasons, metrics, times, options, versions, inputs with hashes, outputs.

    """
    path.write_text(json.dumps(plain(facts), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def plain(value: Any) -> Any:
    """Reduce a value to what JSON knows: arrays become lists, and what is not finite becomes null."""
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple | set):
        return [plain(inner) for inner in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    return str(value)
