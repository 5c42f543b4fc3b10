"""What can go wrong, in words for the person who can mend it.

A message says where, what came, what was needed and what to do.
"""

NOT_TO_BE_USED = "do not use them for this one"
"""Ends a note on products of another run; by these words a batch knows that it was told."""

INTERRUPTED_CODE = 130
"""Exit code of a program that was told to end, as shells have it."""


class BeatfieldError(Exception):
    """Any failure that the program can name; the command line turns it into an exit code."""

    exit_code = 1


class InputError(BeatfieldError):
    """A file, a setting or a command is wrong: the user can mend it."""

    exit_code = 2


class UnregistrableError(InputError):
    """Ultrasound that can be read, but shows too little to be registered."""


class StageError(BeatfieldError):
    """A stage could not do its work on input that is well formed."""
