"""How a verb ends: its errors in words, or all of it as one JSON object; and its exit code."""

import dataclasses
import json
import sys
import traceback
from typing import Any, TypeAlias

from jsecon.app.verbs import Output
from jsecon.errors import InputError

Told: TypeAlias = dict[str, Any]
"""what a verb wrote and its figures: plain values, paths and records; under "refused" the InputErrors of what it could
not do beside that"""


def ended(output: Output, told: Told, code: int = 0) -> int:
    """Tells what was refused, and with --json all that a verb told, the last error as "error", several as "refused";
    returns the exit code, 2 where something was refused."""
    for error in (refused := told.get("refused", ())):
        if output.debug:
            traceback.print_exception(error)
        if not output.json:
            print(f"jsecon: {error}", file=sys.stderr)
    if output.json:
        told = {name: value for name, value in told.items() if name != "refused" or len(refused) > 1}
        print(json.dumps(told | ({"error": refused[-1]} if refused else {}), default=_plain), flush=True)
    return 2 if refused else code


def _plain(value: Any) -> Any:
    """What JSON takes of an error, a record, a path."""
    if isinstance(value, InputError):
        parts = {"name": value.where, "found": value.found, "expected": value.expected, "remedy": value.remedy}
        return {"message": str(value)} | parts
    return vars(value) if dataclasses.is_dataclass(value) else str(value)
