"""What can go wrong while making a phantom, in words for the person who can mend it."""


class SynthError(Exception):
    """A setting, a command or an output place is wrong: the user can mend it (exit code 2)."""

    exit_code = 2
