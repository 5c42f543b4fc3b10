"""beatfield: from a patient's cine MR to a force field that a haptic robot can feel."""

__version__ = "0.1.0"
