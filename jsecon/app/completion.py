"""`jsecon completion`: a script for a shell, made from the parser by shtab."""

import argparse

import shtab

FOLDERS, FILES = ("DIR", "CAPTURE"), ("FIELD", "PLY", "HTML", "FILE")
"""metavars of what lies on disk"""


def script_of(parser: argparse.ArgumentParser, shell: str) -> str:
    """The script that completes verbs, options, choices and paths in bash, zsh or fish."""
    verbs = next(action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    for verb in verbs.choices.values():
        for action in verb._actions:
            if action.metavar in FILES:
                action.complete = shtab.FILE  # pyright: ignore[reportAttributeAccessIssue]
            elif action.metavar in FOLDERS or action.dest in ("out", "capture"):
                action.complete = shtab.DIRECTORY  # pyright: ignore[reportAttributeAccessIssue]
    return shtab.complete(parser, shell)
