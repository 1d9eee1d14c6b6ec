# SPDX-License-Identifier: GPL-3.0-or-later
"""Errors that are shown to a person; each carries the exit code of the command line."""

from __future__ import annotations


class GSkinError(Exception):
    """A failure that gskin explains in one sentence (exit code 1)."""

    exit_code = 1

    def __init__(self, sentence: str = "", *, terminal: str = "") -> None:
        """sentence: for everybody; terminal: what a command line can name besides, which `str` adds in brackets."""
        super().__init__(f"{sentence.removesuffix('.')} ({terminal})." if terminal else sentence)
        self.plain = sentence
        """What a window says: without flags and variables of the command line."""


class InputError(GSkinError):
    """The input cannot be used: names the file or object, the reason and the remedy (exit code 2)."""

    exit_code = 2


class Cancelled(GSkinError):
    """The person stopped the work (exit code 130)."""

    exit_code = 130


class Stopped(Cancelled):
    """The person stopped work that goes on later; says what stays (exit code 130)."""


def first_line(error: BaseException) -> str:
    """The first line of an error's text, without its full stop, to stand inside a sentence."""
    return str(error).strip().split("\n")[0].rstrip(".") or type(error).__name__
