"""beatfield: from a patient's cine MR to a force field that a haptic robot can feel."""

__version__ = "0.1.0"

from contextlib import suppress

from pipeline.caches import provide_place
from pipeline.errors import InputError

INTENDED_USE = "research software: not a medical device, and not for use on patients"

# Compiled code is stored as soon as a module is imported. The command line says what is wrong.
with suppress(InputError):
    provide_place()
