"""Tables of a run as CSV files: rows are added, and a run that goes on first drops what it will do again."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from understudy.files import write_atomically

LOG: Final = "log.csv"
VALIDATION: Final = "validation.csv"
TABLES: Final = MappingProxyType({k: f"validation_{k}.csv" for k in ("joints", "distance", "sensor")})
"""What a validation is broken down by -> file, several rows per validation"""


def read(path: Path) -> list[dict[str, str]]:
    """Rows by their columns; none when there is no such file. Broken rows (an interrupted write) are left out."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as f:
        rows = list(csv.DictReader(f))
    return [r for r in rows if r.get("step", "").isdigit() and None not in r and None not in r.values()]


def append(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Adds rows; a column that is new is empty in the rows that are there."""
    if not rows:
        return
    columns = list(rows[0])
    if path.exists():
        with path.open(newline="", encoding="utf-8") as f:
            before = next(csv.reader(f), [])
        if before == columns:
            with path.open("a", newline="", encoding="utf-8") as f:
                csv.DictWriter(f, columns).writerows(rows)
            return
        columns = list(dict.fromkeys([*before, *columns]))
    _write(path, columns, [*read(path), *rows])


def keep_until(path: Path, step: int) -> None:
    """Drops rows of later steps, and broken ones."""
    if path.exists():
        rows = read(path)
        kept = [r for r in rows if int(r["step"]) <= step]
        with path.open(newline="", encoding="utf-8") as f:
            columns = next(csv.reader(f), [])
        _write(path, columns, kept)


def _write(path: Path, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns)
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(path, text.getvalue())
