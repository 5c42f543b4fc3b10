"""C programs that tests build with the public headers, and run."""

import os
import subprocess
from pathlib import Path

from pipeline.field import get_include

HERE = Path(__file__).parent
SANITIZE = ["-O1", "-g1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
"""Options for a program that ends at the first wrong access or undefined behaviour.

``-g1`` names the lines of a trace; to know where each variable is would take a second to compile,
and ``-O2`` two.
"""


def build(source: Path, target: Path, *options: str, compiler: str = "gcc") -> Path:
    """Compile one source, as C++ by a C++ compiler, where no warning is let pass."""
    command = [compiler, "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror", *options]
    command += [f"-I{get_include()}", "-x", "c++" if "++" in compiler else "c"]
    subprocess.run([*command, str(source), "-o", str(target), "-lm"], check=True)
    return target


def run(program, *words, given=b"", **environment):
    return subprocess.run(
        [program, *map(str, words)],
        input=given,
        capture_output=True,
        env={**os.environ, **environment},
        check=False,
    )
