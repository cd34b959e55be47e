"""Lines said by several threads at once arrive whole."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from pathlib import Path

SPEAKERS, LINES = 4, 2000
PROGRAM = f"""
import sys, threading
sys.setswitchinterval(1e-6)
from tests.said import say
def talk(number):
    for _ in range({LINES}):
        say("speaker", number)
threads = [threading.Thread(target=talk, args=(n,)) for n in range({SPEAKERS})]
for thread in threads: thread.start()
for thread in threads: thread.join()
"""


def test_lines_of_several_threads_are_whole() -> None:
    root = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", PROGRAM], cwd=root, capture_output=True, text=True, check=True)
    assert Counter(done.stdout.splitlines()) == {f"speaker {number}": LINES for number in range(SPEAKERS)}
