"""The end of a verb: its errors as sentences, or its whole result as one JSON object; and its exit code."""

import dataclasses
import json
import sys
import traceback
from typing import Any, TypeAlias

from jsecon.app.verbs import Output
from jsecon.errors import InputError

VerbResult: TypeAlias = dict[str, Any]
"""files and figures of a verb: plain values, paths and records; under "refused" the InputErrors of what it could not do
besides"""


def finish(output: Output, result: VerbResult, code: int = 0) -> int:
    """Prints the errors of a verb, and with --json its result, in which the last error is "error".

    Args:
      output: Options of the output.
      result: Result of the verb.
      code: Exit code if no error is in the result.

    Returns:
      The exit code: 2 if the result has errors.
    """
    refused = result.get("refused", ())
    for error in refused:
        if output.debug:
            traceback.print_exception(error)
        if not output.json:
            print(f"jsecon: {error}", file=sys.stderr)
    if output.json:
        fields = {name: value for name, value in result.items() if name != "refused" or len(refused) > 1}
        if refused:
            fields["error"] = refused[-1]
        print(json.dumps(fields, default=_plain), flush=True)
    return 2 if refused else code


def _plain(value: Any) -> Any:
    """Returns what JSON takes of an error, a record, or a path."""
    if isinstance(value, InputError):
        parts = {"name": value.where, "found": value.found, "expected": value.expected, "remedy": value.remedy}
        return {"message": str(value)} | parts
    return vars(value) if dataclasses.is_dataclass(value) else str(value)
