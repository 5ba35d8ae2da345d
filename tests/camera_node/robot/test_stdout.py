"""Standard output is a command's own, also where a library prints."""

from __future__ import annotations

import subprocess
import sys

SPEAKS = """
import ctypes, os, sys, threading
from camera_node.robot import stdout

libc = ctypes.CDLL(None)
print("before")
with stdout.only_python_output():
    os.write(1, b"from a library\\n")
    libc.printf(b"held back by one\\n")
    print("the answer")
    os.system("echo from a child")
print("after")
os.write(1, b"as ever\\n")
"""


def test_only_what_python_prints_comes_out():
    done = subprocess.run([sys.executable, "-c", SPEAKS], capture_output=True, text=True, check=True)
    assert sorted(done.stdout.split("\n")) == sorted(["before", "the answer", "after", "as ever", ""])
    assert sorted(done.stderr.split("\n")) == sorted(["from a library", "held back by one", "from a child", ""])
