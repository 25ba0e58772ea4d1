"""The ledger's file, beside its field: NAME.evidence/DIGEST.safetensors, whose digest the field's provenance names.

The ledger is written first, then the field, each atomically. So a field never meets the ledger of another, whenever a
program is stopped, and what no field names is removed by the next that writes there.
"""

import dataclasses
import hashlib
import json
import os
from pathlib import Path

import numpy as np

from jsecon.errors import InputError
from jsecon.field.field import save_field
from jsecon.field.ledger import Ledger, LedgerView
from jsecon.files import (
    atomic_write,
    pack_tree,
    parse_json,
    read_arrays,
    reading,
    remove_files,
    unpack_tree,
    write_arrays,
)
from jsecon.types import LanguageField

_REMEDY = "Make the field again with jsecon run, without --no-ledger; the finished stages are reused."


def ledger_file(path: Path, field: LanguageField) -> Path:
    """Returns the path of the ledger of a field's file."""
    return path.with_suffix(".evidence") / f"{parse_json(field.provenance).get('ledger')}.safetensors"


def save_with_ledger(path: Path, field: LanguageField, ledger: Ledger | None) -> LanguageField:
    """Writes a field and its ledger; returns the field as it was written. Ledgers of other fields there are removed."""
    origin, arrays, tree = parse_json(field.provenance), {}, {}
    origin.pop("ledger", None)
    if ledger is not None:
        views = {name: view._asdict() for name, view in ledger.views.items()}
        tree = pack_tree({"num_regions": ledger.num_regions, "views": views}, "", arrays)
        digest = hashlib.blake2b(json.dumps(tree, sort_keys=True).encode(), digest_size=12)
        for array in arrays.values():
            digest.update(np.ascontiguousarray(array).data)
        origin["ledger"] = digest.hexdigest()
    field = dataclasses.replace(field, provenance=json.dumps(origin, sort_keys=True))
    is_new = ledger is not None and not ledger_file(path, field).is_file()
    if is_new:
        with atomic_write(ledger_file(path, field)) as temporary:
            write_arrays(temporary, arrays, {"format": "jsecon-ledger", "version": 2, "ledger": tree})
    try:
        save_field(path, field)
    except InputError:
        if is_new:  # a full disk needs its room
            remove_files(ledger_file(path, field).parent, [ledger_file(path, field).name])
        raise
    remove_stale(path, field)
    return field


def remove_stale(path: Path, field: LanguageField) -> None:
    """Removes ledgers of earlier states of a field, which a stopped program may have left, too."""
    file = ledger_file(path, field)
    if file.parent.is_dir():
        remove_files(file.parent, {*os.listdir(file.parent)} - {file.name})


def load_ledger(path: Path, field: LanguageField) -> Ledger:
    """Reads the ledger of a field's file."""
    file = ledger_file(path, field)
    if "ledger" not in parse_json(field.provenance):
        raise InputError(path, "the field has no ledger of its views", remedy=_REMEDY)
    if not file.is_file():
        problem = f"its ledger is missing: {file.parent.name}/{file.name}"
        raise InputError(path, problem, remedy=f"Copy that folder along with the field. If it is lost: {_REMEDY}")
    with reading(file, "a whole one", _REMEDY, problem="the ledger is damaged"):
        header, arrays = read_arrays(file)
        if [header.get("format"), header.get("version")] != ["jsecon-ledger", 2]:
            raise InputError(file, "it is no ledger of this version of jsecon", remedy=_REMEDY)
        tree = unpack_tree(header["ledger"], arrays)
        ledger = Ledger(tree["num_regions"], {name: LedgerView(**view) for name, view in tree["views"].items()})
        if ledger.num_regions != field.regions.count or not {*ledger.views} <= {*field.names}:
            raise InputError(file, "it is the ledger of another field", remedy=_REMEDY)
        return ledger
