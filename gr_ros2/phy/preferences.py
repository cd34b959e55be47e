"""What GNU Radio keeps in the home directory: its preferences, and what FFTW has learnt about this processor.

Invariant: nothing is tried where the home directory can be written, which is the common case. Where it cannot, versions
of GNU Radio differ in what they need, so the answer comes from a small flowgraph in a separate process.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from gr_ros2.core.errors import PhyError

TRIAL = """
from gnuradio import blocks, fft, gr
fft.fft_vcc(64, True, (), True)
top = gr.top_block()
top.connect(blocks.null_source(8), blocks.head(8, 64), blocks.null_sink(8))
top.run()
"""
"""A program that makes GNU Radio read and write everything that it keeps; it fails where that cannot be done."""


def check_preferences() -> None:
    """Check that GNU Radio can write what it keeps.

    :raises PhyError: with the remedy, when a flowgraph would fail because it cannot
    """
    home = Path(os.environ.get("HOME") or Path.home())
    if home.is_dir() and os.access(home, os.W_OK | os.X_OK):
        return
    done = subprocess.run([sys.executable, "-c", TRIAL], stdin=subprocess.DEVNULL, capture_output=True, check=False)
    if done.returncode:
        said = (done.stderr.decode("utf-8", "replace").strip().splitlines() or ["it ended without a word"])[-1]
        raise PhyError(
            f"HOME = {home} cannot be written, and GNU Radio keeps its preferences there ({said}); set HOME to a "
            "folder of yours, for example HOME=/var/tmp/gr-ros2 after mkdir /var/tmp/gr-ros2"
        )
